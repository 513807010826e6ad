"""What callers of the library give: checked when they give it, in sentences that name the argument."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from tracking3d.config.explain import a_kind, shown
from tracking3d.config.loading import load_config
from tracking3d.config.models import ObjectConfig, PipelineConfig
from tracking3d.errors import InputError, argument
from tracking3d.frames import Frame, Prompt
from tracking3d.images import check_image
from tracking3d.prompts import checked_box, checked_mask
from tracking3d.tracker_choice import AUTO
from tracking3d.video.source import FrameSource


def checked_config(config: Any) -> PipelineConfig:
    """The configuration itself, that of a YAML file, or the default preset.

    Raises:
        InputError: If it is anything else, or the file cannot be used.
    """
    if isinstance(config, PipelineConfig):
        return config
    if config is not None and not isinstance(config, str | Path):
        raise InputError(
            f"config= is {a_kind(config)}; give a PipelineConfig (see load_config) or a YAML file."
        )
    return load_config(Path(config) if config is not None else None)


def check_frame(frame: Any) -> None:
    """Make sure of what `tracking3d.Session.step` was given.

    Raises:
        InputError: If it is no `tracking3d.Frame`, or its image is not ``(H, W, 3)`` uint8.
    """
    if not isinstance(frame, Frame):
        raise InputError(f"frame= is {a_kind(frame)}; wrap the image: Frame(index, image).")
    check_image(frame.image, frame.name or f"Frame {frame.index}")


def check_session(config: Any, prompt: Any, intrinsics: Any) -> None:
    """Make sure of what a `tracking3d.Session` was given.

    Raises:
        InputError: If something cannot be used.
    """
    if not isinstance(config, PipelineConfig):
        raise InputError(f"config= is {a_kind(config)}; give a PipelineConfig, see load_config.")
    if config.tracker.name == AUTO:
        raise InputError(
            f"The tracker '{AUTO}' is chosen by the first frame, in track and record; for a session name one, or take "
            "what tracking3d.tracker_choice.choose_tracker gives."
        )
    if prompt is None and needs_prompt(config):
        raise InputError("Say what the object is by either a box or a mask of the first frame.")
    if prompt is not None:
        if not isinstance(prompt, Prompt):
            raise InputError(
                f"prompt= is {a_kind(prompt)}; make one of the first frame with tracking3d.prompts.make_prompt."
            )
        checked_box(prompt.box, "prompt.box=")
        if prompt.mask is not None:
            checked_mask(prompt.mask, "prompt.mask=")
    if intrinsics is not None:
        try:
            fx, fy, cx, cy = (float(value) for value in intrinsics)
            fits = min(fx, fy) > 0 and all(map(math.isfinite, (fx, fy, cx, cy)))
        except (TypeError, ValueError, OverflowError):
            fits = False
        if not fits:
            raise InputError(
                f"intrinsics={shown(intrinsics)} is not fx, fy, cx, cy in pixels with positive fx and fy."
            )


def needs_prompt(config: PipelineConfig) -> bool:
    """Whether somebody has to say what the object is: neither the mask tracker nor an earlier run knows it."""
    return config.tracker.name != "precomputed" and config.object.known is None


def check_single_known_object(config: PipelineConfig, objects: int) -> None:
    """Make sure that several objects are not all said to be one that is known.

    Raises:
        InputError: If they are.
    """
    if config.object.known is not None and objects > 1:
        raise InputError(
            f"{argument('object=', '--object ')}{config.object.known} is one object, but {objects} are given; track "
            "each in a run of its own."
        )


def with_known(config: PipelineConfig, known: Any) -> PipelineConfig:
    """The configuration for an object that is known; as it is where ``known`` is None.

    Raises:
        InputError: If that is no path.
    """
    if known is None:
        return config
    if not isinstance(known, str | Path):
        raise InputError(f"object= is {a_kind(known)}; give the folder of an earlier run, or a mesh file.")
    told = ObjectConfig.model_validate({**config.object.model_dump(), "known": str(known)})
    return config.model_copy(update={"object": told})


def check_source(source: Any) -> None:
    """Make sure of what `tracking3d.recording.record` was given to read.

    Raises:
        InputError: If it is no source of frames.
    """
    if not isinstance(source, FrameSource):
        raise InputError(f"source= is {a_kind(source)}; open it with tracking3d.video.open_source.")


def checked_folder(folder: Any) -> Path:
    """The run folder.

    Raises:
        InputError: If it is no path.
    """
    if not isinstance(folder, str | Path):
        raise InputError(f"folder= is {a_kind(folder)}; give the path of the run folder.")
    return Path(folder)
