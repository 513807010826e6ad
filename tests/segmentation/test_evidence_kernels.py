"""The compiled inner loops of the evidence say what slow and obvious twins in NumPy and torch say."""

from __future__ import annotations

import numpy as np
import pytest
import twins.colour_models as plain_colours
import twins.motion_cue as plain_motion
import twins.soft_visual_hull as plain_hull

from tracking3d.estimation.segmentation import colour_models, motion_cue, soft_visual_hull
from tracking3d.geometry.camera import Camera, Window
from tracking3d.scene.surface import Drawn

CAMERA = Camera(200.0, 200.0, 79.5, 59.5, 160, 120)
rng = np.random.default_rng(0)


@pytest.mark.parametrize("radius", [2, 9, 70])
def test_labels_around_a_pixel_are_counted_alike(radius):
    labels = rng.integers(0, 7, (48, 48)).astype(np.uint8)
    mask = np.hypot(*(np.mgrid[:48, :48] - 20)) < 13
    fast = colour_models.alike_around(labels, mask, radius, 7)
    np.testing.assert_allclose(fast, plain_colours.alike_around(labels, mask, radius), atol=1e-5)


def test_cells_have_the_same_distances_in_a_view():
    distance = rng.normal(0, 9, (40, 40)).astype(np.float32)
    unknown = np.broadcast_to(np.arange(40) < 6, (40, 40))
    view = np.array([[3.0, 0.1, 0.9, -30.0], [0.2, 2.8, -0.5, -25.0], [0.01, 0.02, 0.1, 4.0]])
    given = distance, unknown, view, 0.3, -40
    fast, plain = soft_visual_hull.sample_grid_distances(*given), plain_hull.carried(*given)
    assert np.mean(fast != plain) < 1e-3  # where rounding decides
    assert 0.01 < np.mean(fast == 127) < 0.9 and len(np.unique(fast)) > 50


def test_a_view_from_within_the_grid_says_nothing():
    within = np.array([[30.0, 0, 0, 0], [0, 30.0, 0, 0], [0, 0, 1.0, -5.0]])
    plane = np.zeros((40, 40), np.float32)
    given = plane, plane > 0, within, 0.3, -40
    assert soft_visual_hull.sample_grid_distances(*given) is None and plain_hull.carried(*given) is None


def test_rays_come_as_deep_into_the_hulls():
    cells = soft_visual_hull.CELLS
    z, y, x = np.mgrid[:cells, :cells, :cells] - 30
    hulls = np.stack([20 - np.sqrt(x**2 + y**2 + z**2), 12 - np.abs(x) - np.abs(y + z)]).astype(np.float32)
    hulls += rng.normal(0, 1, hulls.shape).astype(np.float32)
    hulls = soft_visual_hull.sharpen_peaks(hulls)
    v, u = np.mgrid[:50, :50].astype(np.float32) / 25 - 1
    rays = np.stack([u, v, np.where(u == v, 0, 1)], -1).astype(np.float32)
    origin, depths = np.array([30, 32, -60], np.float32), np.linspace(50, 140, 40, dtype=np.float32)
    given = hulls, origin, rays, rng.permutation(depths), 90.0, -99.0
    fast, plain = soft_visual_hull.march_rays(*given), plain_hull.marched(*given)
    np.testing.assert_allclose(fast, plain, atol=2e-3)
    assert 0.05 < np.mean(plain == -99) < 0.9 and (plain > 0).any()


def test_both_motions_lead_to_the_same_places(monkeypatch):
    pose, moved = np.eye(4), np.eye(4)
    pose[:3, 3], moved[:3, 3] = (0, 0, 7), (0.4, 0.1, 6.5)
    window = Window(30, 10, 96, 48)
    nothing = np.zeros((48, 48), bool)
    inverse_depth = np.where(np.mgrid[:48, :48][0] > 5, rng.uniform(0.1, 0.2, (48, 48)), 0).astype(np.float32)
    image = np.zeros((120, 160, 3), np.uint8)
    scene = Drawn(
        window, image[:48, :48], image.shape[:2], mask=nothing, K=window.K(CAMERA), T_cam_obj=pose,
        inverse_depth=inverse_depth, beyond=inverse_depth,
    )  # fmt: skip
    H = np.array([[1.02, 0.01, -6.0], [0.0, 0.98, 3.0], [1e-4, 0.0, 1.0]])
    target = image, moved, H
    fast = motion_cue._motion_parallax(scene, CAMERA, target)
    monkeypatch.setattr(motion_cue, "motion_parallax", plain_motion.parted_ways)
    plain = motion_cue._motion_parallax(scene, CAMERA, target)
    for one, other in zip(fast, plain, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)
    assert 0.2 < np.mean(fast[1] > 0) < 0.95
