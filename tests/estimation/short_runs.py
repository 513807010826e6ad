"""The solver on a short synthetic clip, with settings that are quick rather than good."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.paper.solver import PaperSolver, PaperState
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize

_COARSE: dict[str, Any] = {"crop": {"size": 32}, "object": {"frequency": 4, "texture_size": 32}}
QUICK: dict[str, dict[str, Any]] = {
    "paper": {
        **_COARSE,
        "solver": {
            "iterations": 30,
            "tau": 0.3,
            "learning_rates": dict.fromkeys(("translation", "rotation", "vertices", "texture"), 0.03),
        },
    },
    "rerendering": {
        **_COARSE,
        "solver": {
            "iterations": 8,
            "tau": 0.5,
            "pose_iterations": 8,
            "init_frames": 3,
            "init_iterations": 4,
        },
    },
}

Mask = NDArray[np.bool_] | None


@cache
def short_clip() -> SyntheticClip:
    """Ten frames of 100 x 80 pixels, 4 degrees apart."""
    return synthesize(SyntheticSpec(frames=10, size=(100, 80), degrees_per_frame=4.0))


def quick_solver(
    preset: str = "rerendering", encoder: FeatureEncoder | None = None, **sections: Any
) -> PaperSolver:
    """A solver of a preset; ``sections`` change settings of a section on top of the quick ones."""
    quick = QUICK[preset]
    # So few iterations fit the mask roughly; the rendered mask is what these tests look at.
    quick = {**quick, "solver": {"min_mask_iou": 0.0, **quick.get("solver", {})}}
    names = {*quick, *sections}
    merged = {name: {**quick.get(name, {}), **sections.get(name, {})} for name in names}
    return PaperSolver(load_config(preset=preset, **merged), short_clip().camera, encoder or RgbEncoder())


def frame(index: int) -> Frame:
    """A frame of the clip; beyond its end it runs backwards, and so on."""
    count = len(short_clip().images)
    place = index % (2 * count - 2)
    return Frame(index, short_clip().images[min(place, 2 * count - 2 - place)], name=f"frame {index}")


def true_mask(index: int) -> NDArray[np.bool_]:
    """The exact mask of `frame`."""
    count = len(short_clip().images)
    place = index % (2 * count - 2)
    return short_clip().masks[min(place, 2 * count - 2 - place)]


def estimate_of(mask: Mask) -> MaskEstimate:
    """What a mask tracker answers."""
    return MaskEstimate(None if mask is None else mask.astype(np.float32))


Run = tuple[list[FrameEstimate], PaperState]


def run(
    solver: PaperSolver,
    frames: Iterable[int] = range(6),
    masks: dict[int, Mask] | None = None,
    after: Run | None = None,
) -> Run:
    """All answers as they came, and the state at the end.

    ``masks`` replaces the exact ones; ``after`` is a run that goes on with ``frames``.
    """
    torch.manual_seed(0)
    given = masks or {}
    estimates: list[FrameEstimate] = list(after[0]) if after else []
    state: PaperState | None = after[1] if after else None
    for index in frames:
        mask = estimate_of(given.get(index, true_mask(index)))
        if state is None:
            state, estimate = solver.init(frame(index), mask)
        else:
            state, estimate = solver.step(state, frame(index), mask)
        estimates.append(estimate)
    assert state is not None
    return estimates, state


@cache
def known_run(preset: str = "rerendering", count: int = 6) -> Run:
    """The first ``count`` frames with exact masks: many tests begin so, and each frame is solved once for all."""
    return run(quick_solver(preset), [count - 1], after=known_run(preset, count - 1) if count > 1 else None)


def revised(estimates: Iterable[FrameEstimate]) -> list[FrameEstimate]:
    """The final answer of every frame."""
    final: dict[int, FrameEstimate] = {}
    for estimate in estimates:
        final |= {better.index: better for better in estimate.revised}
        final[estimate.index] = estimate
    return list(final.values())
