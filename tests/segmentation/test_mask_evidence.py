"""Pixel by pixel, what speaks for the object: two outlines that may be wrong, and the colours of either side."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.estimation.segmentation import (
    SOURCES,
    ColourModels,
    as_lab,
    clean_mask,
    image_weight,
    log_odds,
    pixel_features,
    snap_to_edges,
)

SIZE = 128


def disc(x: float, y: float = 64, radius: float = 30) -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE]
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def picture(mask: np.ndarray, noise: float = 6.0) -> np.ndarray:
    """A warm object before a cool background."""
    random = np.random.default_rng(0)
    colours = np.where(mask[..., None], (200, 120, 60), (60, 110, 170))
    return np.clip(colours + random.normal(0, noise, (SIZE, SIZE, 3)), 0, 255).astype(np.uint8)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def decided(image, initial, rendered, confidence=0.8, colours=None) -> np.ndarray:
    found = pixel_features(as_lab(image), initial, rendered, confidence, colours)
    return snap_to_edges(image, log_odds(found), image_weight(found)) > 0


def test_where_both_outlines_agree_the_image_is_hardly_asked():
    """An exact mask of a small object in a soft picture: edges to the next colour would only pull the outline aside."""
    truth = disc(64)
    soft = cv2.GaussianBlur(picture(truth), (0, 0), 4)
    asked = [
        image_weight(pixel_features(as_lab(soft), truth, disc(64 + off), 0.8, None)) for off in (0, 1, 3, 30)
    ]
    assert asked == sorted(asked) and asked[0] == 0 and asked[-1] == 1
    assert iou(decided(soft, truth, disc(64.5)), truth) > 0.97


def test_there_is_a_weight_for_each_source_and_each_speaks_for_what_it_shows():
    image, mask = picture(disc(64)), disc(64)
    colours = ColourModels.of(as_lab(image), mask)
    seen = pixel_features(as_lab(image), mask, disc(65, radius=34), 0.8, colours)
    assert seen.shape == (SIZE, SIZE, len(SOURCES))
    assert (seen[64, 64] > 0).all()
    assert (seen[64, 8] < 0).all()
    assert all(weight >= 0 for weight in SOURCES.values())


@pytest.mark.parametrize("confidence", [0.1, 0.9])
def test_where_both_masks_are_right_the_answer_is_their_mask(confidence):
    mask = disc(64)
    assert iou(decided(picture(mask), mask, mask, confidence), mask) > 0.97


@pytest.mark.parametrize(
    ("initial", "rendered"), [((58, 64), (64, 70)), ((64, 58), (66, 64)), ((70, 64), (58, 64))]
)
def test_the_image_tells_where_the_outline_is(initial, rendered):
    truth = disc(64)
    initial, rendered = disc(*initial), disc(*rendered)
    answer = decided(picture(truth), initial, rendered)
    assert iou(answer, truth) > max(iou(initial, truth), iou(rendered, truth), 0.93)


def test_a_part_that_the_mask_tracker_left_out_is_taken_in_where_shape_and_colours_want_it():
    truth = disc(64)
    initial = truth & (np.mgrid[:SIZE, :SIZE][1] < 78)
    colours = ColourModels.of(as_lab(picture(truth)), truth)
    answer = decided(picture(truth), initial, truth, colours=colours)
    assert iou(initial, truth) < 0.8 < 0.95 < iou(answer, truth)


def test_a_pose_that_is_not_believed_has_less_say():
    truth, aside = disc(64), disc(76)
    lab = as_lab(picture(truth))
    doubted, believed = (
        log_odds(pixel_features(lab, truth, aside, confidence, None)) for confidence in (0.05, 0.95)
    )
    assert doubted[aside & ~truth].mean() < believed[aside & ~truth].mean() - 0.3


def test_nothing_far_from_both_outlines_is_the_object_whatever_its_colours():
    truth, twin = disc(50, radius=20), disc(105, radius=15)
    image = picture(truth | twin)
    answer = decided(image, truth, truth, colours=ColourModels.of(as_lab(image), truth))
    assert iou(answer, truth) > 0.9
    assert not (answer & disc(105, radius=12)).any()


def test_colours_are_learnt_slowly_and_need_both_sides():
    image = picture(disc(64))
    first = ColourModels.of(as_lab(image), disc(64))
    assert first is not None
    np.testing.assert_allclose(first.histograms.sum(1), 1)
    assert ColourModels.of(as_lab(image), np.zeros((SIZE, SIZE), bool), first) is first
    assert ColourModels.of(as_lab(image), np.ones((SIZE, SIZE), bool)) is None
    swapped = ColourModels.of(as_lab(picture(~disc(64))), disc(64), first)
    ratio = swapped.log_ratio(as_lab(image))
    assert ratio[64, 64] > 0 > ratio[64, 4]


def test_without_the_smoother_the_log_odds_decide(monkeypatch):
    monkeypatch.setattr(
        "tracking3d.estimation.segmentation.mask_extraction.why_no_contrib", lambda name: "it is not there"
    )
    odds = np.where(disc(64), 2.0, -2.0).astype(np.float32)
    np.testing.assert_array_equal(snap_to_edges(picture(disc(40)), odds) > 0, disc(64))


def test_the_outline_is_carried_to_the_edge_of_the_image():
    truth = disc(64)
    odds = np.tanh(cv2.GaussianBlur((disc(64, radius=33) * 2.0 - 1).astype(np.float32), (0, 0), 6))
    image = picture(truth, noise=2)
    assert iou(snap_to_edges(image, odds) > 0, truth) > iou(odds > 0, truth)


def test_hairs_and_crumbs_are_no_part_of_the_object():
    truth = disc(64)
    frayed = truth.copy()
    frayed[64, 90:120] = frayed[20:24, 20:24] = True
    support = np.where(frayed, 0.7, -0.4).astype(np.float32)
    clean = clean_mask(support)
    assert iou(clean > 0, truth) > 0.98
    assert not (clean > 0)[64, 100] and not (clean > 0)[22, 22]
    np.testing.assert_array_equal(clean[~frayed], support[~frayed])
    two = disc(35, radius=20) | disc(95, radius=15)
    assert iou(clean_mask(np.where(two, 1.0, -1.0).astype(np.float32)) > 0, two) > 0.95
    assert not (clean_mask(np.full((SIZE, SIZE), -1.0, np.float32)) > 0).any()


def test_masks_of_nothing_are_survived():
    nothing = np.zeros((SIZE, SIZE), bool)
    assert not decided(picture(disc(64)), nothing, nothing).any()
