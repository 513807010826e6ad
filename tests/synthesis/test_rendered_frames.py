"""Images, masks, depth and point tracks agree with each other and with geometry known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.ndimage import (
    binary_erosion,
    binary_fill_holes,
    distance_transform_edt,
    map_coordinates,
    maximum_filter,
    minimum_filter,
)
from scipy.spatial import ConvexHull

from tracking3d_bench.synthesis.frame_rendering import render_frame
from tracking3d_bench.synthesis.scene import make_scene
from tracking3d_bench.synthesis.sequences import render_sequence
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.texture_lookup import bilinear

QUICK = {"frames": 3, "size": (96, 72), "supersample": 1, "degrees_per_frame": 10.0, "seed": 5}


def sequence(**settings):
    return render_sequence(SequenceSpec(**{**QUICK, **settings}))


def back_projected(rendered, frame):
    """Object points of the pixels in the mask by depth, and the pixels' columns and rows."""
    rows, columns = np.nonzero(rendered.masks[frame])
    K, T = rendered.scene.camera.K, rendered.scene.T_cam_obj[frame]
    rays = np.stack([columns, rows, np.ones(len(rows))], 1) @ np.linalg.inv(K).T
    points = rendered.depth[frame, rows, columns, None] * rays
    return (points - T[:3, 3]) @ T[:3, :3], columns, rows


def projected(rendered, frame, points):
    T = rendered.scene.T_cam_obj[frame]
    homogeneous = (points @ T[:3, :3].T + T[:3, 3]) @ rendered.scene.camera.K.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


@pytest.mark.parametrize("name", ["box", "card", "wedge"])
def test_the_mask_of_a_convex_object_is_the_projected_hull_of_its_corners(name):
    rendered = sequence(object=name)
    y, x = np.mgrid[:72, :96]
    for n, mask in enumerate(rendered.masks):
        hull = ConvexHull(projected(rendered, n, rendered.scene.solid.vertices))
        height = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1) @ hull.equations.T
        clear = np.abs(height).min(1) > 1e-4
        assert (mask.ravel() == (height < 0).all(1))[clear].all() and clear.sum() > 6900


def test_the_depth_of_a_box_lies_on_its_faces():
    rendered = sequence(object="box")
    for n in range(3):
        points, *_ = back_projected(rendered, n)
        room = np.abs(points) - (0.62, 0.48, 0.56)
        assert len(points) > 500 and np.abs(room.max(1)).max() < 1e-5
    assert (rendered.depth > 0).sum() == rendered.masks.sum()


@pytest.mark.parametrize("name", ["mug", "blob", "bottle"])
def test_depth_is_that_of_the_first_surface_along_each_ray(name):
    rendered = sequence(object=name, frames=1)
    scene, T = rendered.scene, rendered.scene.T_cam_obj[0]
    points, *_ = back_projected(rendered, 0)
    points = points[::29]
    # Brute force: every triangle in float64 (Moeller and Trumbore).
    origin = -T[:3, :3].T @ T[:3, 3]
    a, b, c = scene.solid.vertices[scene.solid.faces].transpose(1, 0, 2)
    for point in points:
        d = point - origin
        p, s = np.cross(d, c - a), origin - a
        q = np.cross(s, b - a)
        determinant = ((b - a) * p).sum(1)
        inverse = 1 / np.where(np.abs(determinant) < 1e-15, np.inf, determinant)
        v, w, t = (s * p).sum(1) * inverse, (d * q).sum(1) * inverse, ((c - a) * q).sum(1) * inverse
        t[inverse == 0] = np.inf
        assert t[(v >= -1e-9) & (w >= -1e-9) & (v + w <= 1 + 1e-9)].min() == pytest.approx(1, abs=1e-5)


def test_the_hole_of_the_handle_is_no_part_of_the_mask():
    rendered = sequence(object="mug", frames=12, degrees_per_frame=20.0, size=(160, 120))
    holes = [(binary_fill_holes(mask) & ~mask).sum() for mask in rendered.masks]
    assert max(holes) > 30 and min(holes) == 0  # the handle is seen from the side and edge-on
    n = int(np.argmax(holes))
    hole = binary_fill_holes(rendered.masks[n]) & ~rendered.masks[n]
    unseen = sequence(
        object="mug", frames=12, degrees_per_frame=20.0, size=(160, 120), motion="leave_and_return"
    )
    empty = unseen.images[~unseen.masks.any((1, 2))][0]
    assert (rendered.images[n] == empty)[hole].mean() > 0.99  # the background is seen through it


@pytest.mark.parametrize("name", ["box", "blob", "mug"])
def test_the_texture_sticks_to_the_surface(name):
    rendered = sequence(
        object=name, frames=2, size=(320, 240), supersample=3, degrees_per_frame=6.0, motion="turntable"
    )
    points, columns, rows = back_projected(rendered, 0)
    inner = distance_transform_edt(rendered.masks[0])[rows, columns] > 4
    points, here = points[inner], rendered.images[0][rows, columns].astype(float)[inner]
    there = projected(rendered, 1, points)
    T = rendered.scene.T_cam_obj[1]
    z = (points @ T[:3, :3].T + T[:3, 3])[:, 2]
    x, y = there.round().astype(int).T
    seen = np.abs(rendered.depth[1, y, x] - z) < 0.03
    assert seen.mean() > 0.6
    later = np.stack(
        [
            map_coordinates(c.astype(float), there[:, ::-1].T, order=1)
            for c in rendered.images[1].transpose(2, 0, 1)
        ],
        1,
    )
    stuck = np.abs(later - here)[seen].mean()
    unmoved = np.abs(rendered.images[1][rows, columns][inner] - here)[seen].mean()
    assert stuck < 14
    assert unmoved > 2 * stuck


def test_the_background_does_not_move_and_is_not_touched_by_the_object():
    rendered = sequence(object="blob", supersample=3)
    away = distance_transform_edt(~rendered.masks.any(0)) > 1.5
    assert away.sum() > 2000
    assert (rendered.images[:, away] == rendered.images[0, away]).all()


def test_more_rays_smooth_the_edges_but_leave_the_truth():
    rough, smooth = (sequence(object="mug", supersample=s) for s in (1, 5))
    assert (rough.masks == smooth.masks).all() and (rough.depth == smooth.depth).all()
    edge = np.abs(distance_transform_edt(rough.masks[0]) - 1) < 0.5
    assert (rough.images[0][edge] != smooth.images[0][edge]).mean() > 0.5


def test_a_frame_does_not_depend_on_those_before_it():
    spec = SequenceSpec(**{**QUICK, "disturbances": {"noise": 0.5, "light": 1.0, "occluder": 1.0}})
    rendered = render_sequence(spec)
    alone = render_frame(make_scene(spec), 2)
    assert (alone.image == rendered.images[2]).all() and (alone.mask == rendered.masks[2]).all()


@pytest.mark.usefixtures("made_anew")
def test_the_same_spec_gives_the_same_sequence_and_another_seed_another():
    a, b, c = (sequence(seed=seed, disturbances={"noise": 0.3}) for seed in (1, 1, 2))
    for name in ("images", "masks", "depth"):
        assert (getattr(a, name) == getattr(b, name)).all() and (getattr(a, name) != getattr(c, name)).any()
    assert (a.points.positions == b.points.positions).all()


def test_a_lamp_at_the_upper_left_lights_that_side_and_the_object_shades_itself():
    rendered = sequence(object="blob", textured=False, frames=1, size=(160, 120), supersample=3)
    y, x = np.nonzero(rendered.masks[0])
    light = rendered.images[0][y, x].mean(1)
    upper_left = (x - x.mean()) + (y - y.mean()) < -25
    lower_right = (x - x.mean()) + (y - y.mean()) > 25
    assert light[upper_left].mean() > light[lower_right].mean() + 25


def test_an_open_surface_shows_its_colour_on_both_sides(tmp_path):
    square = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    square.export(tmp_path / "square.ply")
    rendered = sequence(object=str(tmp_path / "square.ply"), motion="flip", frames=10, degrees_per_frame=20.0)
    facing = rendered.scene.T_cam_obj[:, 2, 2]
    brightness = [image[mask].mean() for image, mask in zip(rendered.images, rendered.masks, strict=True)]
    assert facing.min() < -0.9 and facing.max() > 0.9
    assert brightness[facing.argmin()] == pytest.approx(brightness[facing.argmax()], rel=0.1)


def test_bilinear_lookup_meets_texel_centres_averages_between_them_and_repeats():
    texture = np.arange(12, dtype=np.float32).reshape(2, 2, 3)  # row 0 is the upper one
    assert bilinear(texture, np.array([[0.25, 0.75]]))[0] == pytest.approx(texture[0, 0])
    assert bilinear(texture, np.array([[0.75, 0.25]]))[0] == pytest.approx(texture[1, 1])
    assert bilinear(texture, np.array([[0.5, 0.75]]))[0] == pytest.approx(texture[0].mean(0))
    assert bilinear(texture, np.array([[0.0, 0.75]]))[0] == pytest.approx(texture[0].mean(0))
    assert bilinear(texture, np.array([[1.25, -0.25]]))[0] == pytest.approx(texture[0, 0])


def test_points_lie_on_the_surface_and_are_where_the_pose_puts_them():
    rendered = sequence(object="box", size=(160, 120))
    points = rendered.points
    assert points.object_points.shape == (200, 3) and points.visible.any(0).all()
    room = np.abs(points.object_points) - (0.62, 0.48, 0.56)
    assert np.abs(room.max(1)).max() < 1e-9
    for n in range(3):
        assert points.positions[n] == pytest.approx(projected(rendered, n, points.object_points))


def test_a_point_of_a_convex_object_is_visible_where_its_face_looks_at_the_camera():
    rendered = sequence(object="box", degrees_per_frame=40.0)
    points = rendered.points
    half = np.array([0.62, 0.48, 0.56])
    axis = np.abs(np.abs(points.object_points) - half).argmin(1)
    normal = np.eye(3)[axis] * np.sign(points.object_points)
    for n, T in enumerate(rendered.scene.T_cam_obj):
        eye = -T[:3, :3].T @ T[:3, 3]
        facing = ((eye - points.object_points) * normal).sum(1) > 0
        assert (points.visible[n] == facing).all() and facing.any()
    assert (points.visible[0] != points.visible[-1]).any()


def test_visible_points_are_those_whose_depth_the_depth_image_shows():
    rendered = sequence(object="mug", size=(320, 240), frames=4, degrees_per_frame=25.0)
    checked = 0
    for n, T in enumerate(rendered.scene.T_cam_obj):
        z = (rendered.points.object_points @ T[:3, :3].T + T[:3, 3])[:, 2]
        x, y = rendered.points.positions[n].round().astype(int).T
        depth = rendered.depth[n]
        farthest, nearest = maximum_filter(depth, 3)[y, x], minimum_filter(depth, 3)[y, x]
        hidden = (nearest > 0) & (farthest < z - 0.05)
        assert not (rendered.points.visible[n] & hidden).any()
        # The depth image is no finer than a pixel: only points on smooth parts of it must be visible.
        clear = (farthest - nearest < 0.05) & (np.abs(depth[y, x] - z) < 0.02)
        assert rendered.points.visible[n][clear].mean() > 0.98
        checked += hidden.sum()
    assert checked > 100


def test_points_outside_the_image_are_not_visible():
    beyond = np.zeros(2, int)
    for seed in (3, 4):  # the first leaves to the left, the second to the right
        leaving = sequence(motion="leave_and_return", frames=9, seed=seed)
        gone = ~leaving.masks.any((1, 2))
        assert gone.any() and not leaving.points.visible[gone].any()
        seen = leaving.points.positions[leaving.points.visible]
        assert (seen > -0.5).all() and (seen < (95.5, 71.5)).all()
        x = leaving.points.positions[..., 0]
        beyond += ((x > -45) & (x < -1)).sum(), ((x > 97) & (x < 140)).sum()
    assert beyond.min() > 50


def test_points_behind_the_hand_are_not_visible():
    covered = sequence(object="box", frames=5, size=(160, 120), disturbances={"occluder": 1.0})
    checked = 0
    for n in range(5):
        x, y = covered.points.positions[n].round().astype(int).T
        inner = binary_erosion(covered.masks[n] & ~covered.visible_masks[n])[y, x]
        assert not covered.points.visible[n][inner].any()
        checked += inner.sum()
    assert checked > 20


def test_a_camera_so_near_that_it_sees_nothing_else_still_gets_a_frame():
    rendered = sequence(object="box", fill=0.9, fov=100.0)
    assert rendered.masks[0].mean() > 0.1 and np.isfinite(rendered.depth).all()
    assert not (rendered.masks[0][0].any() or rendered.masks[0][-1].any())
