"""Landmarks put poses right, and the outlines of masks the surface's rim, where no landmark is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered_views import CAMERA, ball, pattern, pose, seen

from tracking3d.points import landmark_adjustment
from tracking3d.points.landmark_adjustment import (
    LandmarkScene,
    fit_outlines,
    refine_scene,
    views_with_outlines,
)
from tracking3d.points.outline_fit import outline_of
from tracking3d.points.view import open_view

TRUE = [pose(yaw, 0.4 * yaw) for yaw in np.linspace(0, 48, 9)]
FRAMES = [seen(T, pattern()) for T in TRUE]


def opened(vertices: np.ndarray, edited=lambda index, mask: mask) -> LandmarkScene:
    faces = ball().faces
    views = [
        open_view(image, edited(index, mask), CAMERA, T, vertices, faces)
        for index, (T, (image, mask)) in enumerate(zip(TRUE, FRAMES, strict=True))
    ]
    return LandmarkScene(list(views), vertices, faces)


def agreement(scene: LandmarkScene) -> float:
    """Mean IoU of silhouettes and true masks."""
    shares = []
    for view, (_, mask) in zip(scene.views, FRAMES, strict=True):
        left, top = view.window.left, view.window.top
        height, width = view.image.shape
        drawn, true = view.silhouette, mask[top : top + height, left : left + width]
        shares.append((drawn & true).sum() / (drawn | true).sum())
    return float(np.mean(shares))


@pytest.mark.parametrize("wide", [0.93, 1.08])
def test_silhouettes_come_to_lie_on_the_masks(wide):
    scene = opened(ball().vertices * [1, wide, 1])
    assert agreement(scene) < 0.94
    assert agreement(fit_outlines(refine_scene(scene, 4))) > 0.98


def test_what_hides_the_object_in_some_frames_does_not_dent_it():
    def hidden(index: int, mask: np.ndarray) -> np.ndarray:
        left = np.indices(mask.shape)[1] < mask.shape[1] // 2 - 20
        return mask & ~left if index in (3, 4) else mask

    scene = opened(ball().vertices, hidden)
    refined = fit_outlines(refine_scene(scene, 4))
    assert agreement(refined) > 0.97
    assert np.abs(np.linalg.norm(refined.vertices, axis=1) - 1).max() < 0.1


def test_an_outline_is_half_way_between_pixels_inside_and_outside():
    view = opened(ball().vertices).views[0]
    outline = outline_of(view)
    assert np.array_equal(outline.signed_distance > 0, view.mask > 0.5)
    assert np.abs(outline.signed_distance).min() == 0.5
    assert outline.K[0, 0] == view.intrinsics[0] and outline.K[0, 2] == view.intrinsics[2]
    assert outline.frame_edges.tolist() == [-0.5, view.mask.shape[1] - 0.5, -0.5, view.mask.shape[0] - 0.5]
    assert np.array_equal(outline.T_cam_obj, TRUE[0])


@pytest.mark.parametrize(
    ("views", "fitted"), [(0, 0), (1, 1), (29, 29), (30, 30), (48, 30), (50, 30), (51, 31), (168, 101)]
)
def test_outlines_are_fitted_in_thirty_views_or_six_tenths_of_a_long_video(views, fitted):
    places = views_with_outlines(views)
    assert len(places) == fitted
    if fitted > 1:
        assert (places[0], places[-1]) == (0, views - 1)
        assert np.ptp(np.diff(places)) <= 1


@pytest.mark.parametrize(("left", "rounds"), [(0.85, 12), (0.3, 4)])
def test_rounds_end_where_little_is_to_come(monkeypatch, left, rounds):
    """Of 5 degrees, each round leaves a share."""
    done = []

    def turn(scene: LandmarkScene, free_focal: bool) -> LandmarkScene:
        done.append(len(done))
        return replace(scene)

    monkeypatch.setattr(landmark_adjustment, "_refine_once", turn)
    monkeypatch.setattr(
        landmark_adjustment, "_rotation_between", lambda *scenes: np.radians(5 * left ** len(done))
    )
    refine_scene(LandmarkScene([], np.eye(3), np.eye(3, dtype=np.int64)), 12)
    assert len(done) == rounds
