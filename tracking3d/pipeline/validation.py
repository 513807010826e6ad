"""Validation of the arguments of the library and the command line; messages name the argument."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from tracking3d.config.explain import a_kind, format_value
from tracking3d.config.loading import load_config
from tracking3d.config.models import ObjectConfig, PipelineConfig
from tracking3d.errors import InputError, argument
from tracking3d.frames import Frame, Prompt
from tracking3d.trackers.prompts.prompt import validate_box, validate_mask
from tracking3d.video.source import FrameSource


def validate_config(config: Any) -> PipelineConfig:
    """The configuration: as given, read from a YAML file, or the default preset.

    Raises:
        InputError: It is anything else, or the file cannot be used.
    """
    if isinstance(config, PipelineConfig):
        return config
    if config is not None and not isinstance(config, str | Path):
        raise InputError(
            f"config= is {a_kind(config)}; give a PipelineConfig (see load_config) or a YAML file."
        )
    return load_config(Path(config) if config is not None else None)


def check_frame(frame: Any) -> None:
    """Check the argument of `tracking3d.Session.step`.

    Raises:
        InputError: It is not a `tracking3d.Frame`, or its image is not ``(H, W, 3)`` uint8.
    """
    if not isinstance(frame, Frame):
        raise InputError(f"frame= is {a_kind(frame)}; wrap the image: Frame(index, image).")
    from tracking3d.video.in_memory import check_image

    check_image(frame.image, frame.name or f"Frame {frame.index}")


def check_session(config: Any, prompt: Any, intrinsics: Any) -> None:
    """Check the arguments of `tracking3d.Session`.

    Raises:
        InputError: If one of them cannot be used.
    """
    if not isinstance(config, PipelineConfig):
        raise InputError(f"config= is {a_kind(config)}; give a PipelineConfig, see load_config.")
    if prompt is None and needs_prompt(config):
        raise InputError("Give the object with either a box or a mask in the first frame.")
    if prompt is not None:
        if not isinstance(prompt, Prompt):
            raise InputError(
                f"prompt= is {a_kind(prompt)}; make one with tracking3d.trackers.prompts.prompt.make_prompt."
            )
        validate_box(prompt.box, "prompt.box=")
        if prompt.mask is not None:
            validate_mask(prompt.mask, "prompt.mask=")
    if intrinsics is not None:
        try:
            fx, fy, cx, cy = (float(value) for value in intrinsics)
            fits = min(fx, fy) > 0 and all(map(math.isfinite, (fx, fy, cx, cy)))
        except (TypeError, ValueError, OverflowError):
            fits = False
        if not fits:
            raise InputError(
                f"intrinsics={format_value(intrinsics)} must be fx, fy, cx, cy in pixels, with positive fx and fy."
            )


def needs_prompt(config: PipelineConfig) -> bool:
    """Whether the user must prompt the object: neither masks of all frames nor a known object replace the prompt."""
    return config.tracker.name != "precomputed" and config.object.model is None


def check_single_known_object(config: PipelineConfig, objects: int) -> None:
    """Make sure that a known object is not given together with several prompts.

    Raises:
        InputError: It is.
    """
    if config.object.model is not None and objects > 1:
        raise InputError(
            f"{argument('object=', '--object ')}{config.object.model} is one known object, but {objects} objects are "
            "given; track each in a run of its own."
        )


def set_known_object(config: PipelineConfig, known: Any) -> PipelineConfig:
    """The configuration for a known object; unchanged if ``known`` is None.

    Raises:
        InputError: It is not a path.
    """
    if known is None:
        return config
    if not isinstance(known, str | Path):
        raise InputError(f"object= is {a_kind(known)}; give the folder of an earlier run, or a mesh file.")
    section = ObjectConfig.model_validate({**config.object.model_dump(), "model": str(known)})
    return config.model_copy(update={"object": section})


def check_source(source: Any) -> None:
    """Check the source that `tracking3d.pipeline.record.record` reads.

    Raises:
        InputError: It is not a source of frames.
    """
    if not isinstance(source, FrameSource):
        raise InputError(f"source= is {a_kind(source)}; open it with tracking3d.video.open_source.")


def validate_folder(folder: Any) -> Path:
    """The run folder as a path.

    Raises:
        InputError: It is not a path.
    """
    if not isinstance(folder, str | Path):
        raise InputError(f"folder= is {a_kind(folder)}; give the path of the run folder.")
    return Path(folder)
