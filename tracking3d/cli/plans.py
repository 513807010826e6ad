"""The stages of commands and what they cost, for the estimate of the remaining time.

Seconds were measured on two cores; what counts is how the stages compare.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tracking3d.cli.remaining_time import PlannedStage

_FIRST_TEXTURE = [PlannedStage("texture", 0.5), PlannedStage("writing the model", 0.5)]
_TEXTURE = [PlannedStage("texture", 1.5), PlannedStage("writing the model", 0.5)]
_SHAPE = [
    PlannedStage("carving the hull", 2.4),
    PlannedStage("matching depths", 0.8),
    PlannedStage("fusing depths", 2.7),
    PlannedStage("extracting the surface", 0.25),
    PlannedStage("fitting outlines", 0.65),
    PlannedStage("testing the shape", 0.25),
    PlannedStage("unwrapping the surface", 1.0),
]
_READING = 0.006
"""Seconds of a frame."""


def plan_run(
    config: Mapping[str, Any], frames: int | None, objects: int = 1, report: bool = True, kept: int = 0
) -> list[PlannedStage]:
    """The stages of tracking.

    Args:
        config: The configuration, as ``run.json`` holds it.
        frames: Number of frames; None, as of a camera, plans nothing.
        objects: Number of objects.
        report: Whether a report is written.
        kept: How many frames keep their estimates, because they come before what was corrected.
    """
    if frames is None:
        return []
    made = frames - kept
    count, refines = made * objects, config.get("solver", {}).get("final_refine")
    first = 0.07 * kept if kept else 10.0  # the mask tracker sees them again, or the first map is made
    # Around the frames that are made again, others that stand are looked at, too.
    poses, evidence, masks = (0.33, 0.2, 0.24) if kept else (0.11, 0.025, 0.09)
    plan = [PlannedStage("tracking", first * objects + 0.33 * count, frames)]
    if refines:
        plan += objects * [PlannedStage("refining the map", 2.0)]
        plan += [PlannedStage("refining frames", poses * count, made)]
        plan += objects * _plan_landmarks(frames) if made > kept else []
        plan += [PlannedStage("collecting masks", evidence * count, made)]
        plan += [PlannedStage("refining masks", masks * count, made)]
        plan += objects * _FIRST_TEXTURE
    shape = config.get("object", {}).get("shape")
    if shape == "fine" or (shape == "auto" and refines):
        plan += objects * plan_shape(frames)
    return plan + objects * plan_report(frames) if report else plan


def plan_shape(frames: int) -> list[PlannedStage]:
    """The stages of a new shape from so many frames."""
    return [PlannedStage("reading frames", _READING * frames, frames), *_SHAPE, *_TEXTURE]


def plan_texture(frames: int) -> list[PlannedStage]:
    """The stages of a new texture."""
    return [PlannedStage("reading frames", _READING * frames, frames), *_TEXTURE]


def plan_report(frames: int) -> list[PlannedStage]:
    """The stages of a report."""
    return [PlannedStage("report", 0.01 * frames, frames), PlannedStage("turntable", 0.8)]


def plan_points(frames: int) -> list[PlannedStage]:
    """The stages of following points."""
    reading = PlannedStage("reading frames", 0.05 * frames, frames)
    return [reading, *_plan_landmarks(frames), PlannedStage("following points", 0.05 * frames)]


def _plan_landmarks(frames: int) -> list[PlannedStage]:
    return [PlannedStage("refining poses", 0.2 * frames), PlannedStage("fitting outlines", 2.5)]
