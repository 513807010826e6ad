"""Masks of a turning block: exact ones agree with each other, whatever the surface can follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d.estimation.segmentation.initial_mask_agreement import InitialMaskAgreement
from tracking3d.estimation.segmentation.whole_video import VideoSegmenter, draw_around_masks
from tracking3d.geometry.camera import Camera
from tracking3d.scene.surface import Drawn, draw_depth
from tracking3d.scene.view import ObjectView

CAMERA = Camera(200.0, 200.0, 79.5, 59.5, 160, 120)
BLOCK = trimesh.creation.box((2.4, 0.8, 1.2))
BALL = trimesh.creation.icosphere(3)
FRAMES = 16
Spoil = Callable[[int, np.ndarray], np.ndarray]


def pose(number: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("yx", [12 * number, 20], degrees=True).as_matrix()
    T[:3, 3] = 0, 0, 7
    return T


def exact(number: int, mask: np.ndarray) -> np.ndarray:
    return mask


def with_a_strip(number: int, mask: np.ndarray) -> np.ndarray:
    """Background on another side in each frame."""
    return mask | np.roll(mask, (-1) ** number * (4 + number % 3), number % 2)


def frames(spoil: Spoil = exact) -> list[ObjectView]:
    found = []
    for number in range(FRAMES):
        T = pose(number)
        block = np.asarray(BLOCK.vertices), np.asarray(BLOCK.faces)
        initial = spoil(number, draw_depth(CAMERA.K, T, *block, (120, 160))[1] == 0)
        image = np.random.default_rng(number).integers(0, 256, (120, 160, 3)).astype(np.uint8)
        found.append(ObjectView.of_frame(number, image, initial, CAMERA, T, initial=initial, confidence=0.9))
    return found


def agreement(given: list[ObjectView]) -> InitialMaskAgreement:
    found = InitialMaskAgreement(np.asarray(BALL.vertices, np.float64))
    for one in given:
        found.see(scene_of(one))
    found.settle()
    return found


def scene_of(one: ObjectView) -> Drawn:
    scene = draw_around_masks(one, np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64))
    assert scene is not None
    return scene


def test_exact_masks_stand_though_the_surface_is_a_ball():
    assert agreement(frames()).weight > 0.9


def test_masks_that_differ_from_frame_to_frame_do_not():
    assert agreement(frames(with_a_strip)).weight < 0.1


def behind_a_bar(number: int, mask: np.ndarray) -> np.ndarray:
    """Exact masks of a block behind a bar that passes."""
    hidden = np.zeros_like(mask)
    hidden[:, 40 + 8 * number : 47 + 8 * number] = True
    return mask & ~hidden


def test_exact_masks_behind_something_that_passes_are_kept():
    given = frames(behind_a_bar)
    found = agreement(given)
    assert found.weight > 0.9
    weights = [found.of_frame(scene_of(one)) for one in given]
    assert np.mean(weights) > 0.8


def test_too_few_frames_say_nothing():
    assert agreement(frames()[:3]).weight == 0
    assert agreement([]).weight == 0


def test_a_single_mask_unlike_the_others_does_not_stand():
    given = frames()
    found = agreement(given)
    other = replace(given[5], initial=np.roll(given[5].initial, 9, 0))
    assert found.of_frame(scene_of(given[4])) == 1
    assert found.of_frame(scene_of(other)) < 0.5


def segmenter_of(given):
    """The segmenter that has seen all frames, and the frames with answers that are spoiled."""
    known = VideoSegmenter(
        CAMERA,
        np.asarray(BALL.vertices, np.float64),
        np.asarray(BALL.faces, np.int64),
        {one.index: one.confidence for one in given},
        has_given_masks=True,
    )
    for one in given:
        known.see(one)
    known.settle()
    spoiled = [replace(one, mask=with_a_strip(one.index, one.initial)) for one in given]
    return known, spoiled


def segmented(known: VideoSegmenter, frames: list[ObjectView]) -> list:
    """Every frame of a video whose frames were all seen once, in their order."""
    return [*(one for frame in frames for one in known.decide(frame)), *known.rest()]


def test_exact_masks_come_back_from_the_whole_video():
    given = frames()
    known, spoiled = segmenter_of(given)
    for (index, decided), one in zip(segmented(known, spoiled), given, strict=True):
        assert index == one.index and decided is not None
        assert np.count_nonzero(decided.mask ^ one.initial) < 0.005 * np.count_nonzero(one.initial)


def test_masks_that_agree_a_little_less_are_changed_a_little_more(monkeypatch):
    given = frames()
    known, spoiled = segmenter_of(given)
    changed = []
    for agreement in (1.0, 0.91, 0.89, 0.8, 0.6, 0.0):
        monkeypatch.setattr(InitialMaskAgreement, "of_frame", lambda found, scene, n=agreement: n)
        decided = [one for _, one in segmented(known, spoiled) if one is not None]
        assert len(decided) == FRAMES
        differences = [np.count_nonzero(one.mask ^ given[one.index].initial) for one in decided]
        changed.append(sum(differences) / sum(np.count_nonzero(one.initial) for one in given))
    assert changed == sorted(changed)
    assert changed[0] == 0 and changed[-1] > 0.005
    assert changed[2] - changed[1] < 0.0005  # nothing is switched there
