"""The two words for effort: the quality of a whole run, and its final mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast, get_args

from tracking3d.config.explain import format_value, hint
from tracking3d.config.models import ObjectConfig, PipelineConfig
from tracking3d.errors import InputError, argument

Quality = Literal["draft", "good", "best"]
"""Tracker, resolution, refinement and final mesh together, fastest first."""
ModelChoice = Literal["auto", "none", "fast", "fine"]
"""The final mesh: the online map's, with a texture from the video, with a reconstructed shape, or the best of these."""

QUALITIES: tuple[str, ...] = get_args(Quality)
MODELS: tuple[str, ...] = get_args(ModelChoice)

_IN_A_FILE = {
    "auto": "--model, in a file object.shape: auto",
    "none": "--model, in a file object.texture_views: 0",
    "fast": "--model, in a file object.shape: fast",
    "fine": "--model, in a file object.shape: fine",
}


def check_quality(value: Any, file: Path | None = None) -> Quality:
    """``value``, if it is a quality.

    Args:
        value: What was given.
        file: The configuration file that it is from; None for an argument or option.

    Raises:
        InputError: It is not; if it is a final mesh, the sentence says where that is given.
    """
    if isinstance(value, str) and value in MODELS:
        name, other = (
            argument("quality=", "--quality"),
            argument(f"model=: model='{value}'", f"--model: --model {value}"),
        )
        if file is not None:
            name, other = f"{file}: quality", _IN_A_FILE[value]
        raise InputError(f"{name} sets draft, good or best; {value} is a value of {other}.")
    if value not in QUALITIES:
        raise InputError(f"There is no quality {format_value(value)}; {hint(str(value), QUALITIES)}")
    return cast(Quality, value)


def check_model(value: Any) -> ModelChoice:
    """``value``, if it is a final mesh.

    Raises:
        InputError: It is not; if it is a quality, the sentence says where that is given.
    """
    if isinstance(value, str) and value in QUALITIES:
        name = argument("model=", "--model")
        other = argument(f"quality= of load_config: quality='{value}'", f"--quality: --quality {value}")
        raise InputError(f"{name} sets auto, none, fast or fine; {value} is a value of {other}.")
    if not isinstance(value, str) or value not in MODELS:
        name = argument(f"model={format_value(value)}", f"--model {value}")
        raise InputError(f"{name} is unknown; give 'auto', 'none', 'fast' or 'fine'.")
    return cast(ModelChoice, value)


def set_model(config: PipelineConfig, model: ModelChoice | None) -> PipelineConfig:
    """The configuration with another final mesh; the same if ``model`` is None.

    Raises:
        InputError: The object is known, so that its mesh is fixed, or frames are not re-estimated.
    """
    if model is None or (model == "auto" and config.object.model is not None):
        return config
    shape, name = config.object, argument(f"model='{model}'", f"--model {model}")
    if model != "none" and shape.model is not None:
        what = "shape" if model == "fine" else "texture"
        raise InputError(
            f"{name} makes the {what} again, but those of a known object are fixed; leave it out, or leave out "
            f"{argument('object=', '--object')}."
        )
    if model == "fast" and not config.solver.final_refine:
        raise InputError(
            f"{name} takes the texture from the frames as they are re-estimated, which they are not without the final "
            "refinement (solver.final_refine); leave it out."
        )
    default = ObjectConfig.model_fields["texture_views"].default
    some = shape.texture_views or default
    views = {"auto": some, "none": 0, "fast": some, "fine": shape.texture_views}[model]
    changed = {"texture_views": views, "shape": "fast" if model == "none" else model}
    return config.model_copy(update={"object": shape.model_copy(update=changed)})
