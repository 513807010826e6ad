"""A camera that walks round a still object: the room is rigid with it, at other depths, and never before it."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d_bench.synthesis import room
from tracking3d_bench.synthesis.frame_rendering import render_frame
from tracking3d_bench.synthesis.lighting import lamp_at
from tracking3d_bench.synthesis.pixel_rays import camera_to_pixels, ray_directions
from tracking3d_bench.synthesis.room_rendering import room_light
from tracking3d_bench.synthesis.scene import make_scene
from tracking3d_bench.synthesis.spec import SequenceSpec, check_spec


def walk(**settings) -> SequenceSpec:
    quick = {"object": "bowl", "size": (64, 48), "frames": 40, "supersample": 1, "degrees_per_frame": 3.0}
    return SequenceSpec(**{"motion": "walk_round", "seed": 9001, **quick, **settings})


@pytest.fixture(scope="module", autouse=True)
def coarse_walls():
    """Small images show no more of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "_WALL_TEXELS", 256)
        patch.setattr(room, "_TABLE_TEXELS", 128)
        yield


@pytest.fixture(scope="module")
def scenes():
    """Scenes by lens, each of another object and seed."""
    objects = {8.0: "organic", 25.0: "knob", 75.0: "assembly"}
    return {
        fov: make_scene(walk(fov=fov, object=name, seed=9001 + n))
        for n, (fov, name) in enumerate(objects.items())
    }


def room_depth(scene, T, x, y):
    """Depth of the room along rays through pixels, as if there were no object."""
    lamp = lamp_at(scene.spec, 0, T[:3, 3], scene.solid.radius)
    return room_light(scene, scene.room, T, x, y, lamp, lamp.position)[1]


def test_only_a_camera_that_walks_has_a_room():
    assert make_scene(walk()).room is not None
    assert make_scene(walk(motion="tumble")).room is None


@pytest.mark.slow
@pytest.mark.parametrize("fov", [8.0, 25.0, 75.0])
def test_the_whole_image_shows_the_room_or_the_object(scenes, fov):
    scene = scenes[fov]
    y, x = (grid.ravel().astype(float) for grid in np.mgrid[0:48:3, 0:64:3])
    for T in scene.T_cam_obj[[0, 20, 39]]:
        depth = room_depth(scene, T, x, y)
        assert np.isfinite(depth).all() and depth.min() > 0


@pytest.mark.parametrize("fov", [8.0, 25.0, 75.0])
def test_nothing_of_the_room_is_before_the_object(scenes, fov):
    scene = scenes[fov]
    for frame in (0, 13, 26, 39):
        seen = render_frame(scene, frame)
        y, x = np.nonzero(seen.mask)
        depth = room_depth(scene, scene.T_cam_obj[frame], x.astype(float), y.astype(float))
        assert (depth > seen.depth[y, x] - 1e-3).all()


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [1.0, 9.0])
def test_nothing_is_before_the_object_however_far_the_camera_goes_round(degrees):
    scene = make_scene(walk(degrees_per_frame=degrees, fov=20.0, object="organic", seed=9007))
    for frame in range(0, 40, 4):
        seen = render_frame(scene, frame)
        y, x = np.nonzero(seen.mask)
        depth = room_depth(scene, scene.T_cam_obj[frame], x.astype(float), y.astype(float))
        assert (depth > seen.depth[y, x] - 1e-3).all()


def test_masks_and_depth_are_those_without_the_room(scenes):
    scene = scenes[25.0]
    empty = make_scene(walk(fov=25.0, object="knob", seed=9002))
    object.__setattr__(empty, "room", None)
    for frame in (0, 30):
        with_room, without = render_frame(scene, frame), render_frame(empty, frame)
        assert (with_room.mask == without.mask).all() and (with_room.depth == without.depth).all()
        assert (with_room.image[~with_room.mask] != without.image[~with_room.mask]).any()


@pytest.mark.parametrize("fov", [8.0, 75.0])
def test_points_of_the_room_move_with_the_objects_pose_and_by_parallax(scenes, fov):
    scene = scenes[fov]
    first, later = scene.T_cam_obj[[0, 4]]
    y, x = (grid.ravel().astype(float) for grid in np.mgrid[1:48:2, 1:64:2])
    depth = room_depth(scene, first, x, y)
    points = (depth[:, None] * ray_directions(scene.camera, x, y) - first[:3, 3]) @ first[:3, :3]
    in_later = points @ later[:3, :3].T + later[:3, 3]
    pixels = camera_to_pixels(scene.camera, in_later)
    again = room_depth(scene, later, pixels[:, 0], pixels[:, 1])
    inside = ((pixels > 0) & (pixels < (63, 47))).all(1)
    same = np.abs(again - in_later[:, 2]) < 1e-3 * in_later[:, 2]
    assert same[inside].mean() > 0.8  # others are hidden behind something now

    object_moved = camera_to_pixels(scene.camera, later[:3, 3]) - camera_to_pixels(scene.camera, first[:3, 3])
    moved = pixels - np.stack([x, y], 1)
    far = inside & same & (depth > first[2, 3] + 4 * scene.solid.radius)
    assert far.sum() > 20
    assert np.median(np.linalg.norm(moved[far] - object_moved, axis=1)) > 3


@pytest.mark.slow
def test_the_images_background_moves_with_the_room():
    """A patch of wall looks the same where the poses say that it has gone."""
    scene = make_scene(walk(size=(160, 120), fov=60.0, frames=10, degrees_per_frame=2.0, supersample=3))
    one, other = (render_frame(scene, frame).image.astype(float) for frame in (0, 3))
    first, later = scene.T_cam_obj[[0, 3]]
    y, x = (grid.ravel().astype(float) for grid in np.mgrid[4:116:2, 4:156:2])
    depth = room_depth(scene, first, x, y)
    points = (depth[:, None] * ray_directions(scene.camera, x, y) - first[:3, 3]) @ first[:3, :3]
    pixels = camera_to_pixels(scene.camera, points @ later[:3, :3].T + later[:3, 3])
    column, row = pixels.round().astype(int).T
    here = (column > 0) & (column < 159) & (row > 0) & (row < 119)
    here &= ~render_frame(scene, 0).mask[y.astype(int), x.astype(int)]
    was = one[y.astype(int), x.astype(int)][here]
    moved = np.abs(other[row[here], column[here]] - was).mean()
    stayed = np.abs(other[y.astype(int), x.astype(int)][here] - was).mean()
    assert moved < 0.6 * stayed


@pytest.mark.slow
def test_the_lamp_stays_in_the_room():
    """The same point of a plain object is as bright from everywhere: nothing shines along with the camera."""
    scene = make_scene(walk(object="organic", textured=False, size=(160, 120), frames=20, supersample=3))
    bright = {}
    for frame in (0, 12):
        T = scene.T_cam_obj[frame]
        seen = render_frame(scene, frame)
        y, x = np.nonzero(seen.mask)
        rays = ray_directions(scene.camera, x.astype(float), y.astype(float))
        points = (seen.depth[y, x][:, None] * rays - T[:3, 3]) @ T[:3, :3]
        for place, value in zip((points / 0.03).round().astype(int), seen.image[y, x], strict=True):
            bright.setdefault(tuple(place), {}).setdefault(frame, value.astype(float).mean())
    both = np.array([[seen[0], seen[12]] for seen in bright.values() if len(seen) == 2])
    assert len(both) > 50
    assert np.corrcoef(both.T)[0, 1] > 0.9


def test_a_room_takes_no_background_and_a_lamp_is_somewhere():
    with pytest.raises(InputError, match="its own room"):
        check_spec({"motion": "walk_round", "background": "photos"}, "here")
    with pytest.raises(InputError, match="not all 0"):
        check_spec({"lamp": [0, 0, 0]}, "here")
    with pytest.raises(InputError, match=r"'lamp\.1'"):
        check_spec({"lamp": [0, float("nan"), 1]}, "here")
    with pytest.raises(InputError, match="'print_strength'"):
        check_spec({"print_strength": 1.5}, "here")
