"""Keypoints are where they are said to be, and match what is the same place and nothing else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from patterns import as_grey, disc, moved, shift, speckle, warped

from tracking3d.estimation.online.features.sift import SIFT, Keypoints, detect, detect_turned, match


def blobs(size: int, places: np.ndarray, seed: int = 0) -> np.ndarray:
    """Round spots at ``(N, 2)`` pixels, bright and dark, of several sizes."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size]
    image = np.full((size, size), 110.0)
    for place, width, height in zip(
        places, random.uniform(2, 3.5, len(places)), random.choice([-90, 90], len(places)), strict=True
    ):
        image += height * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * width**2))
    return as_grey(image)


def described(pixel: list[list[float]], descriptor: list[list[float]]) -> Keypoints:
    """Keypoints with given first entries of their descriptors; the others are zero."""
    rows = np.zeros((len(pixel), 128), np.float32)
    rows[:, : len(descriptor[0])] = descriptor
    return Keypoints(np.array(pixel, np.float32), rows)


def errors(a: Keypoints, b: Keypoints, motion: np.ndarray) -> np.ndarray:
    """``(K, 2)`` by how much matches miss a known motion of the image."""
    pairs = match(a, b)
    return b.pixel[pairs[:, 1]] - moved(a.pixel[pairs[:, 0]], motion)


def test_a_textured_patch_has_many_keypoints_inside_the_mask():
    image, mask = speckle((200, 240)), disc((200, 240), (120, 100), 60)
    found = detect(image, mask)
    assert 60 < len(found) <= 260  # SIFT keeps all orientations of the last one
    x, y = np.rint(found.pixel).astype(int).T
    assert mask[y, x].mean() > 0.97
    assert disc((200, 240), (120, 100), 62)[y, x].all()
    assert found.pixel.dtype == np.float32 and found.descriptor.dtype == np.float32
    assert found.descriptor.shape == (len(found), 128)


@pytest.mark.parametrize(
    "mask",
    [np.zeros((60, 60), bool), disc((60, 60), (30, 30), 0), disc((60, 60), (0, 59), 1)],
    ids=["empty", "one pixel", "in a corner"],
)
def test_masks_with_nothing_inside_have_none(mask):
    found = detect(np.full((60, 60), 128, np.uint8), mask)
    assert len(found) == 0 and found.pixel.shape == (0, 2) and found.descriptor.shape == (0, 128)


@pytest.mark.parametrize("radius", [0, 1, 3])
def test_a_tiny_mask_has_few_keypoints_and_all_of_them_near(radius):
    found = detect(speckle((60, 60)), disc((60, 60), (30, 30), radius))
    assert len(found) <= 10
    assert (np.abs(found.pixel - 30) <= radius + 1).all()


@pytest.mark.parametrize("side", [90, 117, 150, 173, 240, 420])
def test_keypoints_are_in_the_middle_of_spots_whatever_the_size_of_the_object(side):
    """The object is enlarged up to twice or reduced to half; neither that nor SIFT itself may move its keypoints."""
    grid = 1 + np.stack(np.meshgrid(*[np.arange(4)] * 2), -1).reshape(-1, 2)
    places = grid * side / 5 + np.random.default_rng(1).uniform(-1, 1, grid.shape)
    found = detect(blobs(side, places), np.ones((side, side), bool))
    gap = found.pixel[:, None] - places
    nearest = np.linalg.norm(gap, axis=2).argmin(0)
    error = gap[nearest, np.arange(16)]
    error = error[np.linalg.norm(error, axis=1) < 1.5]
    assert len(error) >= 12
    assert np.abs(error.mean(0)).max() < 0.05
    assert np.quantile(np.abs(error), 0.9) < 0.2


def test_keypoints_have_pixels_of_the_whole_image():
    patch, mask = speckle((100, 100)), np.zeros((240, 300), bool)
    image = np.full((240, 300), 128, np.uint8)
    image[60:160, 110:210] = patch
    mask[75:145, 125:195] = True
    alone = detect(patch, mask[60:160, 110:210])
    assert len(alone) > 30
    assert np.allclose(detect(image, mask).pixel - [110, 60], alone.pixel)


def test_a_shift_of_the_image_shifts_the_matches_exactly():
    image, motion = speckle(), shift(7.4, -5.7)
    mask = disc(image.shape, (120, 100), 60)
    later = disc(image.shape, (127, 94), 60)
    error = errors(detect(image, mask), detect(warped(image, motion), later), motion)
    assert len(error) > 40
    assert np.median(np.abs(error)) < 0.1 and np.abs(np.median(error, 0)).max() < 0.05


@pytest.mark.parametrize("factor", [0.6, 2.0])
def test_an_object_that_comes_nearer_is_matched_without_bias(factor):
    image = speckle((200, 200), 3.0)
    large = cv2.resize(
        image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    )
    motion = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2]])
    mask = disc(image.shape, (100, 100), 70)
    error = errors(
        detect(image, mask),
        detect(large, disc(large.shape, (100 * factor, 100 * factor), 70 * factor)),
        motion,
    )
    assert len(error) > 25
    assert np.abs(np.median(error, 0)).max() < 0.1


@pytest.mark.parametrize("degrees", [35, 90, 160])
def test_a_rotated_copy_is_matched(degrees):
    image = speckle()
    motion = cv2.getRotationMatrix2D((120, 100), degrees, 1.0)
    mask = disc(image.shape, (120, 100), 70)
    error = np.linalg.norm(errors(detect(image, mask), detect(warped(image, motion), mask), motion), axis=1)
    assert len(error) > 40
    assert (error < 1).mean() > 0.97


def test_another_texture_is_not_matched():
    mask = np.ones((200, 240), bool)
    a, b = detect(speckle(seed=1), mask), detect(speckle(seed=2), mask)
    assert len(match(a, a)) > 0.9 * len(a)
    assert len(match(a, b)) < 0.05 * len(a)


def test_texture_that_repeats_is_doubtful():
    image = np.tile(speckle((40, 40), 1.5), (5, 5))
    found = detect(image, np.ones(image.shape, bool))
    once = detect(image, disc(image.shape, (100, 100), 20))
    assert len(once) > 5
    assert len(match(once, found)) < 0.2 * len(once)


def test_what_is_clearly_the_nearest_is_matched_and_what_is_not_is_not():
    a = described([[0, 0]], [[1.0, 0.0, 0.0]])
    far = described([[0, 0], [50, 0]], [[0.95, 0.05, 0.0], [0.0, 0.0, 1.0]])
    near = described([[0, 0], [50, 0]], [[0.95, 0.05, 0.0], [0.94, 0.0, 0.06]])
    assert match(a, far).tolist() == [[0, 0]]
    assert match(a, near).tolist() == []


def test_the_ratio_is_of_hellinger_distances():
    """Distance of (1, 0) to (c^2, 1 - c^2) is sqrt(2 - 2 c); 0.79 and 0.81 times the second best."""

    def at(distance):
        cosine = 1 - distance**2 / 2
        return [cosine**2, 1 - cosine**2]

    a = described([[0, 0]], [[1.0, 0.0]])
    for share, found in ((0.79, [[0, 0]]), (0.81, [])):
        b = described([[0, 0], [50, 0]], [at(share * 0.6), at(0.6)])
        assert match(a, b).tolist() == found


def test_a_second_descriptor_at_the_same_place_does_not_make_a_match_doubtful():
    a = described([[0, 0]], [[1.0, 0.0, 0.0]])
    rows = [[0.95, 0.05, 0.0], [0.94, 0.0, 0.06], [0.0, 0.0, 1.0]]
    assert match(a, described([[10, 10], [11, 9], [50, 0]], rows)).tolist() == [[0, 0]]
    assert match(a, described([[10, 10], [13, 10], [50, 0]], rows)).tolist() == []


def test_both_descriptors_of_one_place_may_match():
    """A corner with two orientations has two keypoints, whose descriptors have nothing in common."""
    keypoints = described([[10, 10], [10, 10], [60, 10]], [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    assert match(keypoints, keypoints).tolist() == [[0, 0], [1, 1], [2, 2]]


def test_of_two_that_have_the_same_nearest_only_the_nearer_is_matched():
    a = described([[0, 0], [50, 0]], [[0.9, 0.1, 0.0], [1.0, 0.0, 0.0]])
    b = described([[0, 0], [50, 0]], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert match(a, b).tolist() == [[1, 0]]


def test_the_same_descriptor_at_two_places_is_matched_to_neither():
    a = described([[0, 0]], [[0.3, 0.3, 0.4]])
    b = described([[0, 0], [50, 0]], [[0.3, 0.3, 0.4], [0.3, 0.3, 0.4]])
    assert match(a, b).tolist() == []


def test_where_there_is_nothing_to_compare_with_nothing_is_clear():
    one, several = described([[0, 0]], [[1.0]]), detect(speckle(), np.ones((200, 240), bool))
    for a, b in ((Keypoints.none(), several), (several, Keypoints.none()), (several, one), (one, one)):
        assert match(a, b).shape == (0, 2)


def test_a_descriptor_without_entries_gives_no_nan():
    empty = described([[0, 0], [9, 9]], [[0.0], [0.0]])
    assert match(empty, empty).tolist() == []


class BrightSpots:
    """A detector that is not rotation invariant: spots, each described by the pixels around it."""

    rotation_invariant = False

    def detect(self, image, mask, most, contrast):
        bright = (image == cv2.dilate(image, np.ones((9, 9)))) & (image > 170) & mask
        bright[:8], bright[-8:], bright[:, :8], bright[:, -8:] = False, False, False, False
        places = np.argwhere(bright)[:most]
        around = [image[y - 8 : y + 9, x - 8 : x + 9].astype(np.float32).ravel() for y, x in places]
        rows = np.array(around, np.float32).reshape(len(places), 17**2)
        return Keypoints(
            places[:, ::-1].astype(np.float32), rows - rows.mean(1, keepdims=True), "cosine", 0.95
        )


def about_z(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])


@pytest.mark.parametrize("degrees", [0, 35, 90, 160, -100])
def test_an_object_whose_pose_is_known_is_turned_upright(degrees):
    """The picture is turned clockwise by what R says, so that descriptors are those of the first picture."""
    image, mask = speckle(blur=3.0), disc((200, 240), (120, 100), 80)
    motion = cv2.getRotationMatrix2D((120, 100), -degrees, 1.0)
    first, second = (
        detect_turned(seen, mask, BrightSpots(), about_z(angle))[0]
        for seen, angle in ((image, 0), (warped(image, motion), degrees))
    )
    error = np.linalg.norm(errors(first, second, motion), axis=1)
    assert len(error) > 0.4 * len(first) > 8
    assert np.median(error) < 1
    assert (error < 2).mean() > 0.9


def test_where_nothing_tells_which_way_is_up_one_turn_of_four_matches():
    image, mask = speckle(blur=3.0), disc((200, 240), (120, 100), 80)
    motion = cv2.getRotationMatrix2D((120, 100), -80, 1.0)
    first = detect(image, mask, detector=BrightSpots())
    turns = detect_turned(warped(image, motion), mask, BrightSpots())
    found = [len(match(first, turn)) for turn in turns]
    assert len(turns) == 4 and found[3] == max(found) > 3 * found[0]
    assert len(detect_turned(image, mask, SIFT)) == 1


def test_a_detector_that_is_rotation_invariant_sees_the_picture_as_it_is():
    image, mask = speckle(), disc((200, 240), (120, 100), 60)
    plain, turned = detect(image, mask), detect_turned(image, mask, SIFT, about_z(50))[0]
    assert np.array_equal(plain.pixel, turned.pixel)
    assert np.array_equal(plain.descriptor, turned.descriptor)


def test_cosines_are_of_whole_descriptors_whatever_their_length():
    """Distance of unit vectors at an angle a is 2 sin(a / 2); 0.6 of the second best passes a ratio of 0.7."""

    def at(degrees, length):
        return [length * np.cos(np.radians(degrees)), length * np.sin(np.radians(degrees))]

    for nearest, passes in ((30, True), (45, False)):
        a = Keypoints(np.zeros((1, 2), np.float32), np.array([at(0, 3.0)], np.float32), "cosine", 0.7)
        rows = np.array([at(nearest, 0.5), at(-55, 9.0)], np.float32)
        b = Keypoints(np.array([[0, 0], [50, 0]], np.float32), rows, "cosine", 0.7)
        assert len(match(a, b)) == passes
