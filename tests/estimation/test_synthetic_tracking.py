"""Accuracy of both solvers on synthetic sequences with exact masks, against exact truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.pipeline.session import SOLVERS
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import Angles, aligned_rotation_errors, mask_iou

PRESETS = ["default", "rerendering"]


@dataclass(frozen=True, eq=False)
class Tracked:
    """A run of a preset's solver over a clip."""

    clip: SyntheticClip
    answers: list[FrameEstimate]

    @property
    def ious(self) -> list[float]:
        """Of every frame but the first, whose mask is given to any solver."""
        return [mask_iou(a.mask, self.clip.masks[a.index]) for a in self.answers[1:]]

    @property
    def rotation_errors(self) -> Angles:
        """Aligned, of every frame."""
        found = np.stack([estimate.T_cam_obj[:3, :3] for estimate in self.answers])
        return aligned_rotation_errors(found, self.clip.T_cam_obj[:, :3, :3])

    @property
    def angle_turned(self) -> float:
        """Degrees from the first frame to the last."""
        R = self.answers[-1].T_cam_obj[:3, :3] @ self.answers[0].T_cam_obj[:3, :3].T
        return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def tracked(preset: str, spec: SyntheticSpec) -> Tracked:
    clip = synthesize(spec)
    config = load_config(preset=preset)
    solver = SOLVERS[config.solver.name](config, clip.camera, RgbEncoder())
    final: dict[int, FrameEstimate] = {}
    state = None
    for index, image in enumerate(clip.images):
        frame, mask = Frame(index, image), MaskEstimate(clip.masks[index].astype(np.float32))
        state, estimate = solver.init(frame, mask) if state is None else solver.step(state, frame, mask)
        final |= {better.index: better for better in estimate.revised}
        final[index] = estimate
    return Tracked(clip, list(final.values()))


@pytest.fixture(scope="module", params=["default", pytest.param("rerendering", marks=pytest.mark.slow)])
def run(request) -> Tracked:
    """A box with cut corners, which turns by 32 degrees; fewer frames for the solver that takes longer."""
    frames = 9 if request.param == "default" else 7
    spec = SyntheticSpec(shape="chamfered_box", frames=frames, degrees_per_frame=32 / (frames - 1))
    return tracked(request.param, spec)


def test_exact_masks_are_kept_and_rotations_found(run):
    assert np.mean(run.ious) > 0.95
    assert np.median(run.rotation_errors) < 6


def test_no_frame_is_far_off(run):
    assert min(run.ious) > 0.88
    assert run.rotation_errors.max() < 12


def test_the_object_turns_as_far_as_it_does(run):
    assert run.angle_turned == pytest.approx(32, abs=6)


def test_every_frame_is_called_tracked(run):
    assert [estimate.status for estimate in run.answers] == [Status.TRACKED] * len(run.clip.images)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("shape", ["box", "chamfered_box", "ellipsoid"])
def test_longer_sequences_of_every_shape(shape, seed, preset):
    run = tracked(preset, SyntheticSpec(shape=shape, frames=24, degrees_per_frame=3.0, seed=seed))
    assert np.mean(run.ious) > 0.95
    assert np.median(run.rotation_errors) < 6
    assert run.angle_turned == pytest.approx(69, abs=8)
    assert sum(estimate.status is Status.LOST for estimate in run.answers) == 0
