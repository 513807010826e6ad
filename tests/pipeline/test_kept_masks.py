"""Initial masks that are kept come back through no lens; those that are segmented again do go through it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from tracking3d.estimation.segmentation.whole_video import SegmentedMask
from tracking3d.frames import Frame
from tracking3d.geometry.lens import Lens
from tracking3d.pipeline.refinement_steps import RefinementSteps

SIZE = (90, 120)
INTRINSICS = 100.0, 100.0, 59.5, 44.5


def decided_with(is_initial: bool) -> tuple[np.ndarray, np.ndarray]:
    """The mask of a frame, and its initial one, where a mask is decided in the pinhole camera."""
    lens = Lens("radtan", (-0.3, 0.1, 0.0, 0.0), INTRINSICS, INTRINSICS, SIZE[1], SIZE[0])
    initial = np.random.default_rng(1).random(SIZE) > 0.5  # nothing of it survives a resampling
    estimates = SimpleNamespace(
        estimate=lambda index: SimpleNamespace(refined=True), initial_mask=lambda index: initial
    )
    steps = RefinementSteps(estimates, SimpleNamespace(camera=SimpleNamespace(lens=lens)))
    steps._waiting[7] = Frame(7, np.zeros((*SIZE, 3), np.uint8))
    pinhole = lens.mask_to_pinhole(initial)
    _, decided = steps._make_decision((7, SegmentedMask(7, pinhole, pinhole.astype(np.float32), is_initial)))
    return decided.mask, initial


def test_a_kept_mask_is_the_initial_one_to_the_last_pixel():
    mask, initial = decided_with(is_initial=True)
    np.testing.assert_array_equal(mask, initial)


def test_a_mask_that_is_segmented_again_goes_through_the_lens():
    mask, initial = decided_with(is_initial=False)
    assert mask.shape == initial.shape
    assert (mask != initial).any()
