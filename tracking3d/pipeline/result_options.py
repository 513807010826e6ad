"""The caller's options for the result of a tracking, beside the configuration."""

from __future__ import annotations

from typing import Literal, get_args

from tracking3d.config.explain import format_value
from tracking3d.config.models import ObjectConfig, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.pipeline.components import SOLVERS
from tracking3d.reconstruction.rebuild import check_packages
from tracking3d.video.source import FrameSource

ModelChoice = Literal["none", "fast", "fine"]
"""The final mesh of the object."""


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
    if model is not None and model not in get_args(ModelChoice):
        raise InputError(f"model={format_value(model)} is unknown; give 'none', 'fast' or 'fine'.")
    solver, shape = config.solver, config.object
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
    if model in ("fast", "fine") and shape.model is not None:
        raise InputError(
            f"model='{model}' makes the object's {'shape' if model == 'fine' else 'texture'} again, and what is known "
            "of one is held; leave it out."
        )
    if model == "fine":
        if not source.repeatable:
            raise InputError(
                f"model='fine' makes the shape again from all frames, and {source.name} comes once only; give a list "
                "or path, or leave it out."
            )
        check_packages()
    if model == "fast":
        if not solver.final_refine or not source.repeatable:
            raise InputError(
                f"model='fast' takes the texture from the frames as they are estimated a second time, which "
                f"{'they are not without the final refinement' if source.repeatable else f'{source.name} cannot'}; "
                "leave it out."
            )
        least = ObjectConfig.model_fields["texture_views"].default
        shape = shape.model_copy(update={"texture_views": shape.texture_views or least})
    elif model == "none":
        shape = shape.model_copy(update={"texture_views": 0})
    if model is not None:
        shape = shape.model_copy(update={"shape": "fine" if model == "fine" else "fast"})
    return config.model_copy(update={"solver": solver, "object": shape})
