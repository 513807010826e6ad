"""Points of a run that its mesh does not cover: beside the object, on parts without a mesh, and until they meet it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import HalfspaceIntersection

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame
from tracking3d.results.correspondences import PointKind, check_asked, on_mask, track_points
from tracking3d.results.description import RunHeader
from tracking3d.results.point_tracking import open_scene
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_writer import RunWriter
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.video import open_source

FRAMES = 12
ASKED = 3


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES, degrees_per_frame=3.0, drift=(0.4, -0.2, 0.0)))


@pytest.fixture(scope="module")
def solid(clip) -> trimesh.Trimesh:
    planes = np.column_stack([clip.surface.normals, -clip.surface.offsets])
    return trimesh.convex.convex_hull(HalfspaceIntersection(planes, np.zeros(3)).intersections)


def run_of(folder, clip, solid, poses=None, size=1.0) -> RunReader:
    """A run of the clip with true masks; its mesh is so much too small."""
    faces = np.asarray(solid.faces)
    texture = np.zeros((8, 8, 3), np.uint8)
    model = ObjectModel(
        np.asarray(solid.vertices) * size,
        faces,
        np.random.default_rng(0).random((len(faces), 3, 2)),
        texture,
        np.ones((8, 8), np.float32),
        np.zeros((8, 8, 1), np.float32),
    )
    poses = clip.T_cam_obj if poses is None else poses
    header = RunHeader(config={}, camera=clip.camera, source="", seed=0, fps=None, command=None)
    with RunWriter(folder, header) as writer:
        for index, (image, mask, T) in enumerate(zip(clip.images, clip.masks, poses, strict=True)):
            writer.write(
                FrameEstimate(index, None, T, mask, None, Status.TRACKED, "", 1.0), Frame(index, image)
            )
        writer.finish(model, "finished")
    return RunReader(folder)


def scene_of(run, clip):
    return open_scene(run, open_source(list(clip.images)), rounds=0)


def true_positions(clip, xy) -> np.ndarray:
    """``(T, N, 2)`` of the object's points under pixels of the frame that is asked."""
    T, normals, offsets = clip.T_cam_obj[ASKED], clip.surface.normals, clip.surface.offsets
    centre, focal = clip.K[:2, 2], np.diag(clip.K)[:2]
    direction = np.column_stack([(xy - centre) / focal, np.ones(len(xy))]) @ T[:3, :3]
    eye = -T[:3, :3].T @ T[:3, 3]
    along = direction @ normals.T
    enter = np.where(along < 0, (offsets - normals @ eye) / along, -np.inf).max(1)
    points = eye + enter[:, None] * direction
    seen = np.stack([points @ T[:3, :3].T + T[:3, 3] for T in clip.T_cam_obj])
    return seen[..., :2] / seen[..., 2:] * focal + centre


def middle(clip) -> np.ndarray:
    rows, columns = np.nonzero(clip.masks[ASKED])
    return np.array([columns.mean(), rows.mean()])


@pytest.fixture(scope="module")
def run(tmp_path_factory, clip, solid) -> RunReader:
    return run_of(tmp_path_factory.mktemp("whole") / "run", clip, solid)


@pytest.fixture(scope="module")
def scene(run, clip):
    return scene_of(run, clip)


def beside(clip) -> np.ndarray:
    """Pixels that the object is far from in every frame."""
    ever = clip.masks.any(0)
    rows, columns = np.mgrid[12 : ever.shape[0] - 12 : 12, 12 : ever.shape[1] - 12 : 12]
    free = [
        (x, y)
        for x, y in zip(columns.ravel(), rows.ravel(), strict=True)
        if not ever[y - 12 : y + 13, x - 12 : x + 13].any()
    ]
    return np.array(free, float)


def test_points_beside_the_object_have_no_answer_unless_they_are_asked_for(scene, clip):
    xy = np.vstack([beside(clip)[:3], middle(clip)])
    refused, followed = scene.track(ASKED, xy), scene.track(ASKED, xy, beside_object=True)
    assert refused.kind.tolist() == ["none"] * 3 + ["surface"]
    assert np.isnan(refused.positions[:, :3]).all() and not refused.visible[:, :3].any()
    assert followed.kind.tolist() == ["image"] * 3 + ["surface"]
    assert followed.on_object.tolist() == refused.on_object.tolist() == [False] * 3 + [True]
    np.testing.assert_array_equal(followed.positions[:, 3], refused.positions[:, 3])


def test_the_still_background_stays_where_it_is(scene, clip):
    xy = beside(clip)
    tracks = scene.track(ASKED, xy, beside_object=True)
    error = np.linalg.norm(tracks.positions - xy, axis=2)
    assert np.median(error) < 0.1
    assert (error <= 2 * tracks.uncertainty).mean() > 0.9
    assert tracks.visible.mean() > 0.9
    assert np.isnan(tracks.points).all() and (tracks.face == -1).all()


def test_a_pixel_outside_the_frame_is_followed_by_nothing(scene):
    assert scene.track(ASKED, [[-5.0, 3.0]], beside_object=True).kind.tolist() == ["none"]


def test_points_on_parts_without_a_mesh_are_followed_in_the_images(tmp_path, clip, solid):
    small = scene_of(run_of(tmp_path / "run", clip, solid, size=0.6), clip)
    xy = middle(clip) + np.array([(a, b) for a in (-26.0, -22.0, 22.0, 26.0) for b in (-10.0, 0.0, 10.0)])
    xy = xy[on_mask(small.run, ASKED, xy)]
    xy = xy[~track_points(small.run, ASKED, xy).on_object]
    tracks = small.track(ASKED, xy)
    chosen = tracks.kind == PointKind.IMAGE
    assert chosen.sum() >= 4
    assert "tied" not in tracks.kind  # what the small mesh has behind them is not they
    assert tracks.on_object[chosen].all()
    error = np.linalg.norm(tracks.positions - true_positions(clip, xy), axis=2)[:, chosen]
    seen = tracks.visible[:, chosen]
    assert np.median(error[seen]) < 1.5
    assert (error[seen] <= 2 * tracks.uncertainty[:, chosen][seen]).mean() > 0.8


def test_a_point_is_tied_to_the_mesh_where_it_meets_it_and_is_carried_by_it_through_all_frames(
    tmp_path, clip, solid
):
    poses = clip.T_cam_obj.copy()
    poses[ASKED, 0, 3] += 1.6  # where the points are asked for the mesh lies beside the object
    shifted = scene_of(run_of(tmp_path / "run", clip, solid, poses), clip)
    xy = middle(clip) + np.array([(-12.0, -8.0), (-8.0, 0.0), (-4.0, 8.0)])
    assert not track_points(shifted.run, ASKED, xy).on_object.any()
    tracks = shifted.track(ASKED, xy)
    assert tracks.kind.tolist() == ["tied"] * 3
    assert np.isfinite(tracks.points).all() and (tracks.face >= 0).all()
    error = np.linalg.norm(tracks.positions - true_positions(clip, xy), axis=2)
    assert np.median(error) < 0.5 and error.max() < 3
    np.testing.assert_array_equal(tracks.positions[ASKED], xy)
    whole = scene_of(run_of(tmp_path / "true", clip, solid), clip).track(ASKED, xy)
    np.testing.assert_allclose(tracks.points, whole.points, atol=0.05)


def test_what_is_asked_beside_the_mesh_is_told_unless_it_has_an_answer(run, clip):
    away = beside(clip)[:1]
    tracks = track_points(run, ASKED, np.vstack([away, middle(clip)]))
    said = check_asked(tracks, run.camera, otherwise=", or do otherwise")
    assert "are outside the object's mesh" in said and said.endswith(", or do otherwise.")
    assert check_asked(tracks, run.camera, np.array([True, True])) == ""
