"""Rough masks have the asked mean IoU and the faults of real trackers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import mask_iou
from tracking3d_bench.synthesis.mask_degradation import Faults, degrade_to_iou

NOTHING = Faults(wobble=0, leak=0, drift=0, parts=0, dropped=0)


@pytest.fixture(scope="module")
def clip():
    return synthesize(SyntheticSpec(frames=30, size=(160, 120), supersample=1))


def mean_iou(rough, masks):
    return np.mean([mask_iou(a, b) for a, b in zip(rough[1:], masks[1:], strict=True)])


def disc(frames=12, radius=20, centre=(50, 50), size=100):
    y, x = np.indices((size, size))
    mask = np.hypot(x - centre[0], y - centre[1]) < radius
    return np.repeat(mask[None], frames, axis=0)


def grey(masks, object_level=128, background=128):
    return np.where(masks[..., None], object_level, background).astype(np.uint8).repeat(3, axis=-1)


@pytest.mark.parametrize("level", [0.498, 0.732, 0.758, 0.3, 0.9, 0.97])
def test_the_mean_iou_is_the_asked_one(clip, level):
    rough = degrade_to_iou(clip.masks, clip.images, level, seed=3)
    assert rough.shape == clip.masks.shape and rough.dtype == bool
    assert mean_iou(rough, clip.masks) == pytest.approx(level, abs=0.01)


@pytest.mark.parametrize("fault", ["wobble", "leak", "drift", "parts"])
def test_each_fault_alone_can_meet_the_asked_iou(clip, fault):
    faults = Faults(**{**vars(NOTHING), fault: 1.0})
    rough = degrade_to_iou(clip.masks, clip.images, 0.85, seed=1, faults=faults)
    assert mean_iou(rough, clip.masks) == pytest.approx(0.85, abs=0.01)


def test_the_first_frame_keeps_its_true_mask(clip):
    rough = degrade_to_iou(clip.masks, clip.images, 0.5, seed=0)
    assert (rough[0] == clip.masks[0]).all()


def test_one_seed_gives_one_answer_and_another_seed_another(clip):
    first = degrade_to_iou(clip.masks, clip.images, 0.7, seed=5)
    assert (first == degrade_to_iou(clip.masks, clip.images, 0.7, seed=5)).all()
    assert (first != degrade_to_iou(clip.masks, clip.images, 0.7, seed=6)).any()


def test_rough_masks_hang_together(clip):
    rough = degrade_to_iou(clip.masks, clip.images, 0.498, seed=2)
    areas = [
        cv2.connectedComponentsWithStats(mask.astype(np.uint8))[2][1:, cv2.CC_STAT_AREA]
        for mask in rough
        if mask.any()
    ]
    assert np.mean([len(parts) for parts in areas]) < 2
    assert all(parts.min() >= 0.1 * parts.max() for parts in areas)


def test_faults_come_and_go_slowly(clip):
    """Neighbouring frames share their faults, frames far apart do not."""
    still = np.repeat(clip.masks[:1], 60, axis=0)
    rough = degrade_to_iou(still, np.repeat(clip.images[:1], 60, axis=0), 0.7, seed=0)[10:]
    near = np.mean([mask_iou(a, b) for a, b in zip(rough[1:], rough[:-1], strict=True)])
    far = np.mean([mask_iou(a, b) for a, b in zip(rough[25:], rough[:-25], strict=True)])
    assert near > 0.88 > 0.75 > far


def test_leaks_only_go_where_the_background_looks_like_the_object():
    masks = disc(frames=40)
    images = grey(masks)
    images[:, :, 50:] = np.where(masks[:, :, 50:, None], 128, 255)  # only the left half is camouflage
    leaks = Faults(wobble=0, leak=1, drift=0, parts=0, dropped=0)
    grown = degrade_to_iou(masks, images, 0.9, seed=0, faults=leaks) & ~masks
    grown &= ~disc(frames=40, radius=23)  # colours mix at the rim
    assert np.count_nonzero(grown[:, :, :48]) > 500
    assert np.count_nonzero(grown[:, :, 52:]) == 0


def test_leaks_never_take_from_the_object(clip):
    leaks = Faults(wobble=0, leak=1, drift=0, parts=0, dropped=0)
    assert (degrade_to_iou(clip.masks, clip.images, 0.85, seed=0, faults=leaks) >= clip.masks).all()


def test_lost_parts_add_nothing_to_the_object(clip):
    parts = Faults(wobble=0, leak=0, drift=0, parts=1, dropped=0)
    assert (degrade_to_iou(clip.masks, clip.images, 0.85, seed=0, faults=parts) <= clip.masks).all()


def test_drift_moves_the_mask_and_keeps_its_shape():
    masks = disc(frames=40)
    drift = Faults(wobble=0, leak=0, drift=1, parts=0, dropped=0)
    rough = degrade_to_iou(masks, grey(masks), 0.7, seed=0, faults=drift)
    shifts = []
    for mask in rough[5:]:
        y, x = np.nonzero(mask)
        shifts.append(np.hypot(x.mean() - 50, y.mean() - 50))
        # An ellipse's area is pi a b.
        assert np.pi / 4 * np.ptp(x) * np.ptp(y) == pytest.approx(len(x), rel=0.15)
    assert np.mean(shifts) > 2


def test_a_small_share_of_frames_has_no_mask():
    masks = disc(frames=101)
    rough = degrade_to_iou(masks, grey(masks, background=0), 0.6, seed=0, faults=Faults(dropped=0.03))
    assert np.count_nonzero(~rough.any((1, 2))) == 3
    none = degrade_to_iou(masks, grey(masks, background=0), 0.6, seed=0, faults=Faults(dropped=0))
    assert none.any((1, 2)).all()


def test_frames_without_the_object_stay_empty():
    masks = disc()
    masks[5] = False
    rough = degrade_to_iou(masks, grey(masks), 0.7, seed=0)
    assert not rough[5].any() and rough[6].any()


def test_an_object_cut_off_by_the_picture_is_degraded_too():
    masks = disc(centre=(0, 95), radius=25)
    rough = degrade_to_iou(masks, grey(masks, background=30), 0.7, seed=0)
    assert mean_iou(rough, masks) == pytest.approx(0.7, abs=0.01)


@pytest.mark.parametrize("level", [0, -0.1, 1, 1.2, np.nan])
def test_an_impossible_iou_is_refused(clip, level):
    with pytest.raises(ValueError, match="mean_iou"):
        degrade_to_iou(clip.masks, clip.images, level, seed=0)


def test_faults_that_are_all_off_are_refused(clip):
    with pytest.raises(ValueError, match="do not reach a mean IoU"):
        degrade_to_iou(clip.masks, clip.images, 0.5, seed=0, faults=NOTHING)


def test_as_many_images_as_masks_are_needed(clip):
    with pytest.raises(ValueError, match="30 masks and 29 images"):
        degrade_to_iou(clip.masks, clip.images[1:], 0.5, seed=0)
