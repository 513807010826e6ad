"""Silhouettes, a mesh and depths in a volume, against what is known of a ball; kernels against their twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered_views import CAMERA, pattern, pose, seen
from twins import plane_sweep, visual_hull

from tracking3d.geometry.prototypes import sphere
from tracking3d.reconstruction.kernels.visual_hull import vary_little
from tracking3d.reconstruction.meshing import Grid
from tracking3d.reconstruction.plane_sweep import DepthMap, Guide, depth_maps, patch_scores
from tracking3d.reconstruction.shape import (
    are_wide_apart,
    carve_hull,
    depth_evidence,
    fuse_depth,
    mesh_distance,
    restore_uncovered,
)
from tracking3d.reconstruction.views import shape_view, spread_by_rotation
from tracking3d.scene.view import ObjectView

SIDE = 96


def shape_views(yaws, pitch: float = 0.0) -> list[ObjectView]:
    """The ball with its pattern, turned by these degrees."""
    views = []
    for index, yaw in enumerate(yaws):
        image, mask = seen(pose(yaw, pitch), pattern())
        views.append(shape_view(ObjectView.of_frame(index, image, mask, CAMERA, pose(yaw, pitch)), SIDE))
    return views


@pytest.fixture(scope="module")
def around() -> list[ObjectView]:
    return shape_views(range(0, 360, 30)) + shape_views((0, 90, 180, 270), 60)


def test_the_hull_of_a_ball_is_the_ball(around):
    points = np.random.default_rng(1).uniform(-1.3, 1.3, (2000, 3)).astype(np.float32)
    hull, known = carve_hull(points, around, 0.4, 0.0, 0)
    radius = np.linalg.norm(points, axis=1)
    inside = radius < 0.95
    beside = (np.hypot(*points[:, [0, 2]].T) > 1.1) & (np.abs(points[:, 1]) < 0.8)
    assert (hull[inside] > 0).all() and (hull[beside] < 0).all()
    assert (known[inside] == len(around)).all()


def test_wrong_masks_carve_nothing_as_long_as_they_are_few(around):
    nothing = replace(around[3], mask=np.zeros_like(around[3].mask))
    middle = np.zeros((1, 3), np.float32)
    views = [*around[:3], nothing, *around[4:]]
    assert carve_hull(middle, views, 0.4, 0.0, 1)[0] > 0
    assert carve_hull(middle, views, 0.4, 0.0, 0)[0] < 0


def test_nothing_is_known_beyond_the_frame(around):
    window = around[0].window  # the frame begins in its middle
    half = replace(around[0], window=replace(window, left=-window.side // 2))
    left = np.array([[-0.5, 0, 0]], np.float32)
    assert carve_hull(left, [half], 0.4)[1] == 0
    assert carve_hull(left, [around[0]], 0.4)[1] == 1


def test_kernel_and_twin_of_the_hull_agree(around):
    points = np.random.default_rng(2).uniform(-1.3, 1.3, (500, 3)).astype(np.float32)
    given = points, around, 0.4, 0.1, 1
    kernel, twin = carve_hull(*given), visual_hull.robust_hull(*given)
    np.testing.assert_allclose(kernel[0], twin[0], atol=1e-5)
    np.testing.assert_array_equal(kernel[1], twin[1])


def test_the_distance_of_a_mesh_is_exact_and_signed():
    mesh = sphere(6)
    grid = Grid.around(mesh.vertices, 16, 0.2)
    distance = mesh_distance(grid, mesh.vertices, mesh.faces, 0.5)
    expected = 1 - np.linalg.norm(grid.points, axis=1)
    assert np.abs(distance - np.clip(expected, -0.5, 0.5)).max() < 0.04  # flat faces lie within the ball
    assert ((distance > 0) == (expected > 0))[np.abs(expected) > 0.04].all()


def test_a_part_that_is_turned_inside_out_has_an_inside():
    mesh = sphere(6)
    grid = Grid.around(mesh.vertices, 16, 0.2)
    outward = mesh_distance(grid, mesh.vertices, mesh.faces, 0.5)
    np.testing.assert_array_equal(
        mesh_distance(grid, mesh.vertices, mesh.faces[:, ::-1], 0.5) > 0, outward > 0
    )


def test_a_shape_grows_where_views_show_the_object_beside_it(around):
    mesh = sphere(6)
    grid = Grid.around(mesh.vertices, 24, 0.2)
    hull, _ = carve_hull(grid.points, around, 0.4)
    ball = mesh_distance(grid, mesh.vertices, mesh.faces, 0.5)
    half = np.minimum(ball, grid.points[:, 1] + 0.2)  # what is below a plane is missing
    restored = restore_uncovered(grid, hull, half, around)
    assert (half[ball > 0.1] > 0).mean() < 0.7
    assert (restored[ball > 0.1] > 0).mean() > 0.9
    np.testing.assert_array_equal(restored[hull <= 0], half[hull <= 0])


def test_a_shape_that_covers_the_object_stays_as_it_is(around):
    mesh = sphere(6)
    grid = Grid.around(mesh.vertices, 24, 0.2)
    hull, _ = carve_hull(grid.points, around, 0.4)
    ball = mesh_distance(grid, mesh.vertices, mesh.faces, 0.5)
    np.testing.assert_array_equal(restore_uncovered(grid, hull, ball, around), ball)


def test_what_lies_beyond_a_window_has_no_vote(around):
    mesh = sphere(6)
    grid = Grid.around(mesh.vertices, 16, 0.2)
    ball = mesh_distance(grid, mesh.vertices, mesh.faces, 0.5)
    everywhere = np.full(len(grid.points), 0.1, np.float32)
    # The object fills the windows, whose edges many voxels lie beyond.
    nearer = np.diag([3, 3, 1])
    full = np.ones_like(around[0].mask)
    close = [replace(view, K=nearer @ view.K, mask=full) for view in around]
    seen_by = np.zeros(len(grid.points), int)
    for view in close:
        x, y, z = view.P[:, :3] @ grid.points.T + view.P[:, 3:]
        seen_by += (
            (np.rint(x / z) >= 0) & (np.rint(x / z) < SIDE) & (np.rint(y / z) >= 0) & (np.rint(y / z) < SIDE)
        )
    half = np.minimum(ball, grid.points[:, 1] + 0.2)
    restored = restore_uncovered(grid, everywhere, half, close)
    assert (restored != half).any() and (seen_by[restored != half] >= 3).all()


def test_where_there_is_no_shape_the_hull_takes_its_place(around):
    grid = Grid.around(sphere(6).vertices, 12, 0.2)
    hull, _ = carve_hull(grid.points, around, 0.4)
    np.testing.assert_array_equal(restore_uncovered(grid, hull, np.full_like(hull, -1), around), hull)


def test_patches_find_the_depth_of_a_ball():
    views = shape_views((-24, -12, 0, 12, 24))
    small = sphere(8)
    guide = Guide(0.94 * small.vertices, small.faces)
    (found,) = depth_maps(views, [views[2]], guide, 0.12, 8)[:1] or [None]
    assert not np.isfinite(found.depth).any()  # nobody confirms the only map
    maps = depth_maps(views, views[1:4], guide, 0.12, 8)
    true, _ = Guide(small.vertices, small.faces).visible_to(maps[1].view)
    known = np.isfinite(maps[1].depth) & np.isfinite(true)
    assert known.sum() > 100
    at_first, _ = guide.visible_to(maps[1].view)
    error, before = (np.abs(depth[known] - true[known]) for depth in (maps[1].depth, at_first))
    assert np.median(error) < 0.3 * np.median(before)


def test_photos_in_wide_steps_find_what_lies_behind_the_surface_at_hand(around):
    views = around[:5]  # 30 degrees apart
    ball = sphere(8)
    guide = Guide(1.4 * ball.vertices, ball.faces)
    assert not depth_maps(views, views, guide, 0.12, 8)  # nobody to compare with
    found = depth_maps(views, views, guide, 0.12, 8, wide=True)[1]
    true, _ = Guide(ball.vertices, ball.faces).visible_to(found.view)
    known = np.isfinite(found.depth) & np.isfinite(true)
    assert known.sum() > 100
    assert np.median(np.abs(found.depth[known] - true[known])) < 0.05


@pytest.mark.parametrize(("step", "wide"), [(2, False), (8, False), (15, True), (30, True)])
def test_photos_in_wide_steps_are_told_from_a_video(around, step, wide):
    poses = [pose(step * n, 0) for n in range(9)]
    assert are_wide_apart([replace(around[0], T_cam_obj=T) for T in poses]) is wide


def test_kernel_and_twin_of_the_sweep_agree():
    random = np.random.default_rng(3)
    image, *others = random.uniform(0, 255, (3, 40, 40)).astype(np.float32)
    K_inverse = np.linalg.inv(np.array([[60.0, 0, 20], [0, 60, 20], [0, 0, 1]]))
    P = np.stack([np.array([[60.0, 0, 20, shift], [0, 60, 20, 1], [0, 0, 1, 0.1]]) for shift in (2, -3)])
    pixels = random.integers(0, 40, (60, 2))
    normal = random.normal(size=(60, 3)) * 0.3 - (0, 0, 1)
    given = (image, np.ones_like(image), K_inverse, np.stack(others), P, pixels, np.full(60, 3.0), normal)
    offsets = np.linspace(-0.5, 0.5, 5)
    kernel, twin = patch_scores(*given, offsets), plane_sweep.patch_scores(*given, offsets)
    assert (kernel[0] > -1).any() and (kernel[0] == -1).any()
    for one, other in zip(kernel, twin, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-3)


def test_a_depth_is_a_surface_and_free_space_before_it(around):
    view = around[0]
    one = DepthMap(view, np.full((SIDE, SIDE), 4.5, np.float32), np.ones((SIDE, SIDE), np.float32))
    points = np.array([[0, 0, -1.0], [0, 0, -0.5], [0, 0, 0.5]], np.float32)  # z of the camera: 4, 4.5, 5.5
    total, weight = depth_evidence(points, [one], 0.2)
    assert total[0] < 0 and abs(total[1]) < 1e-6 and weight[1] == 1 and weight[2] == 0
    everywhere = np.full(3, 0.1, np.float32)
    inside = fuse_depth((1, 1, 3), everywhere, everywhere, 5 * total, 5 * weight, 0.2, variation=0)
    assert inside[0] < 0 < inside[2]
    hull = fuse_depth((1, 1, 3), -everywhere, everywhere, total, weight, 0.2)
    assert (hull < 0).all()  # nothing is beyond it


def test_views_that_show_the_same_are_one(around):
    assert len(spread_by_rotation([around[0]] * 5, 1.0, 10)) == 1
    assert len(spread_by_rotation(around, 1.0, 100)) == len(around)
    assert len(spread_by_rotation(around, 1.0, 5)) <= 5


def test_noise_and_holes_go_and_the_surface_stays():
    grid = Grid.around(np.array([[-1.0] * 3, [1.0] * 3]), 24, 0.1)
    radius = np.linalg.norm(grid.points, axis=1)
    ball, truncation = (1 - radius).astype(np.float32), 0.3
    rng = np.random.default_rng(0)
    weight = np.where(rng.random(len(ball)) < 0.7, 4.0, 0.0).astype(np.float32)  # the rest is known to nobody
    noisy = np.clip(ball + rng.normal(0, 0.2, len(ball)), -truncation, truncation).astype(np.float32)
    far = np.full_like(ball, 1.0)
    made = fuse_depth(grid.shape, far, -far, noisy * weight, weight, truncation)
    rough = fuse_depth(grid.shape, far, -far, noisy * weight, weight, truncation, variation=0)
    wrong, before = ((one > 0) != (ball > 0) for one in (made, rough))
    assert wrong.mean() < 0.5 * before.mean()


def test_kernel_and_twin_of_the_total_variation_agree():
    rng = np.random.default_rng(3)
    mean, weight, most = rng.normal(0, 1, (3, 5, 7, 9)).astype(np.float32)
    given = mean, np.abs(weight), most, 0.1, 0.5, 20, np.minimum(mean, most)
    twin = visual_hull.vary_little(*given)
    vary_little(*given)
    np.testing.assert_allclose(given[-1], twin, atol=1e-5)


def test_what_is_known_of_a_coarse_grid_is_known_of_a_fine_one():
    coarse = Grid.around(np.array([[-1.0] * 3, [1.0, 0.5, 0.7]]), 12, 0.1)
    fine = coarse.around_centres(coarse.points[:, 0] > 0, coarse.spacing / 3)
    plane = np.array([0.3, -0.2, 0.5])
    found = coarse.resample((coarse.points @ plane).astype(np.float32), fine)
    within = ((fine.points >= coarse.points.min(0)) & (fine.points <= coarse.points.max(0))).all(1)
    assert within.mean() > 0.5
    np.testing.assert_allclose(found[within], (fine.points @ plane)[within], atol=1e-5)


def test_a_map_of_every_other_pixel_is_known_everywhere(around):
    depth = np.full((SIDE, SIDE), np.nan, np.float32)
    depth[::3, ::3] = 4.5
    points = np.random.default_rng(2).uniform(-0.3, 0.3, (50, 3)).astype(np.float32)
    sparse = DepthMap(around[0], depth, np.ones((SIDE, SIDE), np.float32), 3)
    assert (depth_evidence(points, [sparse], 1.5)[1] > 0).all()
