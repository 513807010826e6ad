"""Points that the images alone follow: against pictures that are moved by formula, and hidden on purpose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.points.image_following import expected_image_error, follow_in_images
from tracking3d.points.pictures import (
    likeness,
    open_picture,
    patches,
    placement_variance,
)

SIZE = 160, 120
FRAMES = 13
ASKED = 6
NO_OBJECT = np.zeros((SIZE[1], SIZE[0]), bool)


def painted(seed: int = 0, width: int = 480, height: int = 360) -> np.ndarray:
    """Grey spots of some pixels."""
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX)


def motion(frame: int) -> np.ndarray:
    """Of the picture in a frame: it turns, grows and goes by."""
    M = cv2.getRotationMatrix2D((240, 180), 1.2 * (frame - ASKED), 1.01 ** (frame - ASKED))
    M[:, 2] += np.array([2.0, -1.0]) * (frame - ASKED) - (160, 120)
    return M


def frame_of(picture: np.ndarray, frame: int) -> np.ndarray:
    noise = np.random.default_rng(frame).normal(0, 1.5, (SIZE[1], SIZE[0]))
    grey = (cv2.warpAffine(picture, motion(frame), SIZE) + noise).clip(0, 255).astype(np.uint8)
    return np.dstack([grey] * 3)


def truth(xy: np.ndarray) -> np.ndarray:
    """``(T, N, 2)``."""
    back = cv2.invertAffineTransform(motion(ASKED))
    points = xy @ back[:, :2].T + back[:, 2]
    return np.stack([points @ M[:, :2].T + M[:, 2] for M in (motion(frame) for frame in range(FRAMES))])


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    picture = painted()
    return [frame_of(picture, frame) for frame in range(FRAMES)]


@pytest.fixture(scope="module")
def xy() -> np.ndarray:
    return np.random.default_rng(1).uniform((45, 40), (115, 80), (40, 2))


def opened(frames, masks=None):
    return [open_picture(image, NO_OBJECT if masks is None else masks[n]) for n, image in enumerate(frames)]


def test_points_are_followed_to_and_fro_from_any_frame(frames, xy):
    tracks = follow_in_images(opened(frames), ASKED, xy)
    error = np.linalg.norm(tracks.positions - truth(xy), axis=2)
    assert np.median(error) < 0.15
    assert np.quantile(error, 0.95) < 0.8
    assert tracks.visible.mean() > 0.97
    np.testing.assert_array_equal(tracks.positions[ASKED], xy)


def test_twice_the_uncertainty_holds_nearly_all_errors_and_grows_with_the_way(frames, xy):
    tracks = follow_in_images(opened(frames), ASKED, xy)
    error = np.linalg.norm(tracks.positions - truth(xy), axis=2)
    assert (error <= 2 * tracks.uncertainty).mean() > 0.9
    assert np.median(tracks.uncertainty[-1]) > 2 * np.median(tracks.uncertainty[ASKED])
    assert np.median(tracks.uncertainty[-1]) < 5


def test_a_point_that_something_covers_is_not_seen_and_comes_back(frames, xy):
    covered = [image.copy() for image in frames]
    stripes = np.dstack([painted(seed=9)[: SIZE[1], : SIZE[0]].astype(np.uint8)] * 3)
    exact = truth(xy)
    for frame in (9, 10):
        covered[frame][30:90, 40:90] = stripes[30:90, 40:90]
    tracks = follow_in_images(opened(covered), ASKED, xy)
    hidden = ((exact[9] > (47, 37)) & (exact[9] < (83, 83))).all(1)
    hidden &= ((exact[10] > (47, 37)) & (exact[10] < (83, 83))).all(1)
    free = exact[9, :, 0] > 100
    assert hidden.sum() > 5 and free.sum() > 3
    assert tracks.visible[9:11, hidden].mean() < 0.1
    assert tracks.visible[9:11, free].all()
    assert tracks.visible[11:, hidden].mean() > 0.8
    back = np.linalg.norm(tracks.positions[12] - exact[12], axis=1)[hidden & tracks.visible[12]]
    assert np.median(back) < 0.5
    assert (tracks.uncertainty[9, hidden] > tracks.uncertainty[8, hidden]).all()


def test_a_hidden_point_goes_along_with_what_is_around_it(frames, xy):
    exact = truth(xy)
    middle = np.linalg.norm(xy - (80, 60), axis=1) < 15
    covered = [image.copy() for image in frames]
    for frame in (9, 10, 11):
        cv2.circle(
            covered[frame],
            tuple(exact[frame, middle].mean(0).round().astype(int).tolist()),
            30,
            (9, 9, 9),
            -1,
        )
    tracks = follow_in_images(opened(covered), ASKED, xy[middle])
    gone = ~tracks.visible[11]
    assert gone.any()
    error = np.linalg.norm(tracks.positions[11] - exact[11, middle], axis=1)[gone]
    stayed = np.linalg.norm(tracks.positions[8] - exact[11, middle], axis=1)[gone]
    assert np.median(error) < 0.5 * np.median(stayed)


def test_what_lies_where_the_object_is_has_to_look_the_same(frames, xy):
    # The object comes over half of the picture and looks different there: its pixels are not those beside it.
    masks = [NO_OBJECT.copy() for _ in frames]
    other = np.dstack([painted(seed=5)[: SIZE[1], : SIZE[0]].astype(np.uint8)] * 3)
    covered = [image.copy() for image in frames]
    for frame in range(9, FRAMES):
        masks[frame][:, 60:] = True
        covered[frame][:, 60:] = other[:, 60:]
    tracks = follow_in_images(opened(covered, masks), ASKED, xy)
    under = (truth(xy)[9:, :, 0] > 64).all(0)
    assert under.sum() > 20
    assert tracks.visible[9:, under].mean() < 0.05


def test_a_frame_that_is_missing_has_no_answer_and_ends_nothing(frames, xy):
    pictures = opened(frames)
    pictures[8] = None
    tracks = follow_in_images(pictures, ASKED, xy)
    assert np.isnan(tracks.positions[8]).all() and not tracks.visible[8].any()
    assert np.isnan(tracks.uncertainty[8]).all()
    assert np.median(np.linalg.norm(tracks.positions[9:] - truth(xy)[9:], axis=2)) < 0.3
    assert np.isnan(follow_in_images(pictures, 8, xy).positions).all()


def test_patches_are_values_between_pixels_and_alike_whatever_the_light():
    grey = painted().astype(np.uint8)
    at = np.array([[50.0, 40.0], [60.5, 70.25]])
    taken = patches(grey, at)
    assert taken[0, 6, 6] == grey[40, 50]
    assert taken[1, 6, 6] == pytest.approx(
        0.375 * (float(grey[70, 60]) + grey[70, 61]) + 0.125 * (float(grey[71, 60]) + grey[71, 61]), abs=1
    )
    assert (likeness(taken, 0.7 * taken + 20) > 0.95).all()
    assert abs(likeness(taken[:1], taken[1:])[0]) < 0.5
    many = np.repeat(at, 4000, 0)  # more than OpenCV takes at once
    np.testing.assert_array_equal(patches(grey, many)[[0, -1]], taken)


def test_along_an_edge_a_patch_is_placed_badly():
    corner, edge, plain = np.full((3, 13, 13), 50, np.float32)
    corner[6:, 6:] = edge[:, 6:] = 200
    variance = placement_variance(np.stack([corner, edge, plain]), np.stack([corner, edge, plain]), 3.0)
    assert 100 * variance[0] < variance[1]
    assert variance[2] >= variance[1]


def test_pixels_know_how_far_inside_the_mask_they_lie():
    mask = NO_OBJECT.copy()
    mask[20:60, 30:90] = True
    picture = open_picture(np.zeros((*NO_OBJECT.shape, 3), np.uint8), mask)
    depth = picture.depth_in_mask(np.array([[60.0, 25.0], [60.0, 10.0], [30.0, 40.0], [29.0, 40.0]]))
    np.testing.assert_allclose(depth, [5.5, -9.5, 0.5, -0.5], atol=0.6)
    assert (open_picture(np.zeros((*NO_OBJECT.shape, 3), np.uint8), NO_OBJECT).inside < -100).all()
    assert picture.holds(np.array([[0.0, 0.0], [159.4, 119.4], [159.6, 3.0], [np.nan, 0.0]])).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_what_is_known_worse_is_expected_to_be_further_off():
    assert (np.diff(expected_image_error([0.01, 0.1, 1.0], 3, 0)) > 0).all()
    assert (np.diff(expected_image_error(0.1, [1, 5, 25], 0)) > 0).all()
    assert (np.diff(expected_image_error(0.1, 5, [1, 5, 25])) > 0).all()
