"""The online solver over a small synthetic clip of a solid that turns."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import Angles, aligned_rotation_errors

FRAMES = 14
Mask = NDArray[np.bool_] | None
Run = tuple[SolverState, list[FrameEstimate]]


@cache
def turning_clip() -> SyntheticClip:
    """A box with cut corners, turning 5 degrees a frame."""
    return synthesize(
        SyntheticSpec(frames=FRAMES, size=(160, 120), degrees_per_frame=5.0, drift=(0.2, -0.1, 0.2))
    )


@cache
def solver() -> OnlineSolver:
    """With the default settings, but for a shape of fewer vertices."""
    config = load_config(preset="default", overrides=["object.frequency=7"])
    return OnlineSolver(config, turning_clip().camera, RgbEncoder())


def frame(index: int, shown: int | None = None) -> Frame:
    """Frame ``index``, which shows the clip's image ``shown``, or the one of the same index."""
    return Frame(index, turning_clip().images[index if shown is None else shown], name=f"frame {index}")


def empty_frame(index: int) -> Frame:
    """A frame in which nothing is to be seen."""
    return Frame(index, np.full_like(turning_clip().images[0], 120))


def estimate_of(mask: Mask) -> MaskEstimate:
    """What a mask tracker answers."""
    return MaskEstimate(None if mask is None else mask.astype(np.float32))


def true_mask(index: int) -> NDArray[np.bool_]:
    """Of an image of the clip."""
    return turning_clip().masks[index]


def run(frames: Iterable[tuple[Frame, Mask]], after: Run | None = None) -> Run:
    """The state at the end, and every answer as it came; ``after`` is a run that goes on with ``frames``."""
    state, estimates = (after[0], list(after[1])) if after else (None, [])
    for shown, mask in frames:
        given = estimate_of(mask)
        state, estimate = solver().init(shown, given) if state is None else solver().step(state, shown, given)
        estimates.append(estimate)
    assert state is not None
    return state, estimates


def with_true_masks(indices: Iterable[int] = range(FRAMES)) -> list[tuple[Frame, Mask]]:
    """Frames of the clip and their masks."""
    return [(frame(index), true_mask(index)) for index in indices]


@cache
def known_run(count: int) -> Run:
    """The first ``count`` frames with true masks; each is solved once for all tests."""
    return run(with_true_masks([count - 1]), after=known_run(count - 1) if count > 1 else None)


def whole_run() -> Run:
    """The whole clip with true masks."""
    return known_run(FRAMES)


def final(estimates: Iterable[FrameEstimate]) -> list[FrameEstimate]:
    """The last causal answer for every frame, in order of time."""
    found: dict[int, FrameEstimate] = {}
    for estimate in estimates:
        found |= {better.index: better for better in estimate.revised}
        found[estimate.index] = estimate
    return [found[index] for index in sorted(found)]


def revisited(state: SolverState, estimates: Iterable[FrameEstimate]) -> Run:
    """The refined state, and every frame once more; ``estimates`` are the final causal ones."""
    state, refined = solver().refine(state), []
    for estimate in estimates:
        given = estimate_of(estimate.initial_mask)
        state, better = solver().refine_frame(state, frame(estimate.index), given, estimate.T_cam_obj)
        refined.append(better)
    return state, refined


@cache
def refined_run() -> Run:
    """The whole run, looked at once more."""
    state, estimates = whole_run()
    return revisited(state, final(estimates))


def rotation_errors(estimates: list[FrameEstimate]) -> Angles:
    """Against the clip's truth, in degrees."""
    found = np.stack([estimate.T_cam_obj[:3, :3] for estimate in estimates])
    true = turning_clip().T_cam_obj[[estimate.index for estimate in estimates], :3, :3]
    return aligned_rotation_errors(found, true)
