"""Masks weighed once more when the whole video is known: known objects before known backgrounds."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from tracking3d.estimation.segmentation import whole_video
from tracking3d.estimation.segmentation.motion_cue import (
    background_motion,
    flow_distance,
    motion_cue,
    small_grey,
)
from tracking3d.estimation.segmentation.soft_visual_hull import SoftVisualHull
from tracking3d.estimation.segmentation.temporal_neighbours import TemporalNeighbours
from tracking3d.estimation.segmentation.whole_video import (
    PixelEvidence,
    VideoSegmenter,
    alignment,
    draw_around_masks,
    edge_strength,
)
from tracking3d.estimation.segmentation.whole_video_weights import WEIGHTS
from tracking3d.geometry.camera import Camera
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import ObjectView
from tracking3d.trackers.outline import inside_distance

CAMERA = Camera(200.0, 200.0, 79.5, 59.5, 160, 120)
BALL = trimesh.creation.icosphere(3)
VERTICES, FACES = np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64)
DEPTH = 7.0
RADIUS = 200 / np.sqrt(DEPTH**2 - 1)  # pixels of the ball's outline


def texture(seed: int, low: int, high: int) -> np.ndarray:
    small = np.random.default_rng(seed).integers(low, high, (80, 110, 3)).astype(np.uint8)
    return cv2.resize(small, (220, 160), interpolation=cv2.INTER_LINEAR)


def frame(number: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A ball that moves by 4 pixels a frame over a background that stands: image, mask and pose."""
    column = 50 + 4 * number
    rows, columns = np.mgrid[:120, :160]
    mask = (rows - 59.5) ** 2 + (columns - column) ** 2 < RADIUS**2
    ball = np.roll(texture(seed + 1, 90, 220), 4 * number, 1)[:120, :160]
    image = np.where(mask[..., None], ball, texture(seed, 20, 150)[:120, :160])
    T = np.eye(4)
    T[:3, 3] = (column - 79.5) / 200 * DEPTH, 0, DEPTH
    return image, mask, T


def answered(number: int, spoil=lambda mask: mask, **changes) -> ObjectView:
    image, mask, T = frame(number)
    return replace(seen(number, image, spoil(mask), T), **changes)


def seen(number: int, image: np.ndarray, mask: np.ndarray, T: np.ndarray, **known) -> ObjectView:
    return ObjectView.of_frame(number, image, mask, CAMERA, T, initial=mask, confidence=0.9, **known)


def with_strip(mask: np.ndarray) -> np.ndarray:
    """With a strip of background at its lower side."""
    return mask | np.roll(mask, 7, 0)


def segmented(known: VideoSegmenter, frames: list[ObjectView]) -> list:
    """Every frame of a video whose frames were all seen once, in their order."""
    return [*(one for frame in frames for one in known.decide(frame)), *known.rest()]


def looked_at(frames: list[ObjectView]) -> dict[int, np.ndarray | None]:
    known = VideoSegmenter(CAMERA, VERTICES, FACES, {one.index: one.confidence for one in frames})
    for one in frames:
        known.see(one)
    known.settle()
    found = list(segmented(known, frames))
    assert [index for index, _ in found] == [one.index for one in frames]
    for _, decided in found:
        if decided is not None:
            np.testing.assert_array_equal(decided.mask, decided.probability > 0.5)
    return {index: None if decided is None else decided.mask for index, decided in found}


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def test_a_strip_of_background_in_all_masks_is_taken_out():
    found = looked_at([answered(number, with_strip) for number in range(12)])
    before = [overlap(with_strip(frame(number)[1]), frame(number)[1]) for number in found]
    after = [overlap(mask, frame(number)[1]) for number, mask in found.items()]
    assert np.mean(after) > np.mean(before) + 0.05 and np.min(after) > np.min(before)


def test_frames_decided_side_by_side_are_the_same_to_the_last_digit(monkeypatch):
    frames = [answered(number, with_strip) for number in range(12)]
    masks = []
    for at_a_time in (1, 2):
        monkeypatch.setattr(whole_video, "_AT_A_TIME", at_a_time)
        masks.append(looked_at(frames))
    for index in masks[0]:
        np.testing.assert_array_equal(masks[0][index], masks[1][index])


def test_only_masks_that_something_contradicts_are_decided_where_masks_may_be_kept():
    frames = [
        answered(0),  # from before the first map
        answered(1),
        answered(2, with_strip),  # the silhouette says otherwise
        replace(answered(3), initial=with_strip(frame(3)[1])),  # the mask tracker says otherwise
        replace(answered(4), initial=frame(4)[1] & False),
        *(answered(number) for number in range(5, 12)),
    ]
    known = VideoSegmenter(
        CAMERA, VERTICES, FACES, {one.index: 0.9 for one in frames}, may_keep=range(1, 12), agreement=0.95
    )
    for one in frames:
        known.see(one)
    known.settle()
    assert known.kept == {1, *range(4, 12)}
    assert [index for index in range(12) if known.needs(index)] == list(range(12))  # they tell the motion
    found = dict(segmented(known, frames))
    assert {index for index, decided in found.items() if decided is not None} == {0, 2, 3}


def with_gap(number: int, filled: bool) -> ObjectView:
    """The background shows through the middle, which surface and, if ``filled``, both masks call the object."""
    one = answered(number)
    gap = np.hypot(*(np.mgrid[:120, :160] - np.array([59.5, 50 + 4 * number])[:, None, None])) < 14
    background = cv2.GaussianBlur(texture(0, 20, 150)[:120, :160], (0, 0), 9)
    image = np.where(one.mask[..., None] & ~gap[..., None], one.image, background)
    mask = one.mask if filled else one.mask & ~gap
    return replace(one, image=image, mask=mask, initial=mask)


@pytest.mark.parametrize("filled", [range(0, 12, 3), range(12)])
def test_masks_that_nothing_contradicts_are_decided_where_other_frames_see_through_them(filled):
    frames = [with_gap(number, number in filled) for number in range(12)]
    known = VideoSegmenter(
        CAMERA, VERTICES, FACES, {one.index: 0.9 for one in frames}, may_keep=range(12), agreement=0.95
    )
    for one in frames:
        known.see(one)
    known.settle()
    assert known.kept == (set(filled) if len(filled) == len(frames) else set())


def test_frames_whose_poses_are_doubted_are_not_decided():
    doubted = range(9, 30)
    frames = [answered(number % 12, index=number) for number in range(30)]
    frames = [replace(one, confidence=0.4) if one.index in doubted else one for one in frames]
    known = VideoSegmenter(CAMERA, VERTICES, FACES, {one.index: one.confidence for one in frames})
    for one in frames:
        known.see(one)
    known.settle()
    assert known.kept == set(doubted)
    assert [index for index in range(30) if known.needs(index)] == list(range(17))  # eight tell the motion
    found = dict(segmented(known, frames))
    assert {index for index, decided in found.items() if decided is None} == set(doubted)


def test_frames_far_from_all_that_are_decided_are_not_needed():
    frames = [answered(number % 12, index=number) for number in range(30)]
    known = VideoSegmenter(
        CAMERA, VERTICES, FACES, {one.index: 0.9 for one in frames}, may_keep=range(1, 30), agreement=0.95
    )
    for one in frames:
        known.see(one)
    known.settle()
    assert [index for index in range(30) if known.needs(index)] == list(range(9))


def test_a_frame_of_a_doubted_pose_keeps_its_mask():
    frames = [answered(number, with_strip, confidence=0.15 if number == 6 else 0.9) for number in range(12)]
    found = looked_at(frames)
    assert found[6] is None
    assert found[5] is not None


def test_exact_masks_stay_what_they_are():
    found = looked_at([answered(number) for number in range(12)])
    assert min(overlap(mask, frame(number)[1]) for number, mask in found.items()) > 0.97


def bar_in_front(first: int) -> np.ndarray:
    """Eight columns of the frame."""
    columns = np.arange(160)
    return np.broadcast_to((columns >= first) & (columns < first + 8), (120, 160))


def behind(bar: np.ndarray, number: int) -> ObjectView:
    """A frame with a bar in front, which the masks leave out."""
    image, mask, T = frame(number)
    image = np.where(bar[..., None], 128, image).astype(np.uint8)
    return seen(number, image, mask & ~bar, T, occluder=bar)


def test_a_mask_goes_on_behind_what_is_in_front_for_a_while():
    bar = bar_in_front(70)  # the ball passes behind it
    found = looked_at([behind(bar, number) for number in range(12)])
    for number, mask in found.items():
        truth = frame(number)[1]
        assert overlap(mask & bar, truth & bar) > 0.7 or np.count_nonzero(truth & bar) < 50
        assert overlap(mask, truth) > 0.9


def test_what_is_hidden_in_every_frame_is_not_made_up():
    found = looked_at([behind(bar_in_front(60 + 4 * number), number) for number in range(12)])
    for number, mask in found.items():
        bar = bar_in_front(60 + 4 * number)  # moves with the ball
        assert np.count_nonzero(mask & bar) < 0.3 * np.count_nonzero(frame(number)[1] & bar)


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param([answered(0)], id="one frame"),
        pytest.param([answered(n, lambda mask: mask & False) for n in range(3)], id="no mask"),
        pytest.param(
            [answered(n, lambda mask: mask | True) for n in range(3)], id="masks that fill the image"
        ),
        pytest.param([answered(n, T_cam_obj=np.full((4, 4), np.nan)) for n in range(3)], id="lost"),
        pytest.param(
            [answered(n, image=np.full((120, 160, 3), 90, np.uint8)) for n in range(9)], id="one grey"
        ),
    ],
)
def test_what_cannot_be_told_is_left_as_it_is(frames):
    for index, mask in looked_at(frames).items():
        assert mask is None or overlap(mask, frames[index].mask) > 0.9


def test_a_mask_that_would_change_beyond_belief_stands():
    elsewhere = [answered(number, lambda mask: np.roll(mask, 45, 1)) for number in range(3)]
    found = looked_at(
        [answered(number) for number in range(3, 12)] + [replace(e, index=20 + e.index) for e in elsewhere]
    )
    assert all(
        found[20 + number] is None or overlap(found[20 + number], elsewhere[number].mask) > 0.6
        for number in range(3)
    )


def scenes(count: int, spoil=lambda mask: mask) -> list[Drawn]:
    found = [draw_around_masks(answered(number, spoil), VERTICES, FACES) for number in range(count)]
    return [scene for scene in found if scene is not None]


def test_the_drawn_surface_is_the_ball():
    for scene in scenes(3):
        assert overlap(scene.silhouette, scene.mask) > 0.95
        assert scene.inverse_depth.max() == pytest.approx(1 / (DEPTH - 1), rel=0.02)


def test_a_hull_of_exact_masks_has_their_outline_and_one_wrong_mask_carves_nothing():
    views = scenes(12)
    for wrong in (False, True):
        consensus = SoftVisualHull(VERTICES)
        for number, scene in enumerate(views):
            consensus.see(replace(scene, mask=scene.mask & False) if wrong and number == 5 else scene)
        consensus.settle()
        wide = consensus.drawn(views[7])[1]
        assert overlap(wide > 0, views[7].mask) > 0.9


def test_few_views_have_no_hull():
    consensus = SoftVisualHull(VERTICES)
    consensus.see(scenes(1)[0])
    consensus.settle()
    assert consensus.drawn(scenes(1)[0]) is None


def test_the_ball_moves_with_itself_and_the_background_stands():
    order = TemporalNeighbours()
    for number in range(6):
        order.add(answered(number))
    scene = scenes(4)[3]
    targets = order.around(3, scene, CAMERA)
    assert len(targets) == 2
    np.testing.assert_allclose(targets[0][2], np.eye(3), atol=0.3)
    assert flow_distance(scene, CAMERA, targets[0]) >= 4
    cue = motion_cue(scene, CAMERA, targets)
    inside, outside = cv2.erode(scene.mask.astype(np.uint8), np.ones((9, 9))) > 0, ~scene.mask
    for one in cue:
        assert one[inside].mean() > 0.3 and one[outside].mean() < -0.1


def test_what_is_even_or_stands_still_moves_with_anything():
    even = [replace(answered(n), image=np.full((120, 160, 3), 90, np.uint8)) for n in range(2)]
    assert background_motion(*(small_grey(one.image) for one in even), even[0].mask) is None
    scene, still = scenes(1)[0], answered(0)
    assert not motion_cue(scene, CAMERA, [(still.image, still.T_cam_obj, np.eye(3))]).any()


def test_an_outline_on_edges_is_told_from_one_beside_them():
    disc = np.hypot(*(np.mgrid[:96, :96] - 48)) < 30
    lab = np.where(disc[..., None], 200, 60).astype(np.uint8).repeat(3, 2)
    edges = edge_strength(lab)
    around = np.hypot(*(np.mgrid[:96, :96] - 48))
    on, off = (alignment(edges, inside_distance(around < radius))[1] for radius in (30, 24))
    assert on > 1 > 0 > off
    assert alignment(edges, inside_distance(disc & False)) == (pytest.approx(np.zeros((96, 96))), 0.0)


def test_every_source_is_odd_and_has_a_weight():
    scene = scenes(1)[0]
    hulls = np.stack([np.where(scene.mask, 5, -5).astype(np.float32)] * 2)
    said = PixelEvidence.of(scene, hulls, None, np.zeros((2, *scene.mask.shape), np.float32))
    planes = dict(said.sources())
    assert set(planes) == set(WEIGHTS)
    mirrored = replace(
        said,
        distances={name: -one for name, one in said.distances.items()},
        colours=-said.colours,
        motion=-said.motion,
    )
    for name, plane in mirrored.sources():
        np.testing.assert_allclose(plane, -planes[name], atol=1e-6)
