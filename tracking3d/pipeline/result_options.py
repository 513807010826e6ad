"""The caller's options for the result of a tracking, beside the configuration."""

from __future__ import annotations

from tracking3d.config.choices import ModelChoice, check_model, set_model
from tracking3d.config.explain import format_value
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.pipeline.components import SOLVERS
from tracking3d.reconstruction.rebuild import check_packages
from tracking3d.video.source import FrameSource


def config_of_result(
    config: PipelineConfig, source: FrameSource, refine: bool | None, model: ModelChoice | None
) -> PipelineConfig:
    """The configuration with the caller's options for the result.

    Args:
        config: The pipeline.
        source: The frames.
        refine: Whether everything is solved once more; None as configured.
        model: The final mesh; None as configured.

    Raises:
        InputError: If that is not possible with this solver or these frames, or a package is missing.
    """
    if refine is not None and not isinstance(refine, bool):
        raise InputError(f"refine={format_value(refine)} is neither True nor False.")
    if model is not None:
        check_model(model)
    solver = config.solver
    if refine is not None:
        solver = solver.model_copy(update={"final_refine": refine})
    if refine and not hasattr(SOLVERS[solver.name], "refine"):
        raise InputError(
            f"refine=True: the solver {solver.name} gives causal estimates only; choose solver.name online."
        )
    if refine and not source.repeatable:
        raise InputError(
            f"refine=True: {source.name} comes once only, and all frames are needed a second time; give a list or path."
        )
    config = set_model(config.model_copy(update={"solver": solver}), model)
    if model == "fine":
        if not source.repeatable:
            raise InputError(
                f"model='fine' makes the shape again from all frames, and {source.name} comes once only; give a list "
                "or path, or leave it out."
            )
        check_packages()
    if model == "fast" and not source.repeatable:
        raise InputError(
            f"model='fast' takes the texture from the frames as they are re-estimated, which {source.name} does not "
            "allow; leave it out."
        )
    return config
