"""The stages of commands and what they cost, for the estimate of the remaining time.

Seconds were measured on two cores; what counts is how the stages compare.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tracking3d.cli.remaining_time import PlannedStage

_REFINEMENT = {
    "refining the map": 0.06,
    "refining frames": 0.08,
    "refining poses": 0.22,
    "fitting outlines": 0.11,
    "collecting masks": 0.03,
    "refining masks": 0.07,
}
"""Seconds of a frame."""
_TRACKING = 0.4
_SHAPE = {
    "reading frames": 0.03,
    "carving the hull": 0.03,
    "matching depths": 0.1,
    "fusing depths": 0.01,
    "extracting the surface": 0.02,
    "testing the shape": 0.06,
}
_TEXTURE = [PlannedStage("texture", 3.0), PlannedStage("writing the model", 1.5)]
_REPORT = 0.02
_TURNTABLE = PlannedStage("turntable", 5.0)


def plan_run(
    config: Mapping[str, Any], frames: int | None, objects: int = 1, report: bool = True
) -> list[PlannedStage]:
    """The stages of tracking.

    Args:
        config: The configuration, as ``run.json`` holds it.
        frames: Number of frames; None, as of a camera, plans nothing.
        objects: Number of objects.
        report: Whether a report is written.
    """
    if frames is None:
        return []
    count = frames * objects
    plan = [PlannedStage("tracking", _TRACKING * count)]
    if config.get("solver", {}).get("final_refine"):
        plan += [PlannedStage(name, seconds * count) for name, seconds in _REFINEMENT.items()]
        plan += _TEXTURE
    shape = config.get("object", {}).get("shape")
    if shape == "fine" or (shape == "auto" and config.get("solver", {}).get("final_refine")):
        plan += plan_shape(count)
    return plan + plan_report(count) if report else plan


def plan_shape(frames: int) -> list[PlannedStage]:
    """The stages of a new shape from so many frames."""
    return [*(PlannedStage(name, seconds * frames) for name, seconds in _SHAPE.items()), *_TEXTURE]


def plan_texture(frames: int) -> list[PlannedStage]:
    """The stages of a new texture."""
    return [PlannedStage("reading frames", _SHAPE["reading frames"] * frames), *_TEXTURE]


def plan_report(frames: int) -> list[PlannedStage]:
    """The stages of a report."""
    return [PlannedStage("report", _REPORT * frames), _TURNTABLE]


def plan_points(frames: int) -> list[PlannedStage]:
    """The stages of following points."""
    seconds = {
        "reading frames": 0.05,
        "refining poses": 0.4,
        "fitting outlines": 0.1,
        "following points": 0.05,
    }
    return [PlannedStage(name, each * frames) for name, each in seconds.items()]
