from __future__ import annotations

import csv
import dataclasses
import io
import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.geometry.similarity import Similarity
from tracking3d.results import layout
from tracking3d.results.correspondences import (
    COLUMNS,
    grid_on_object,
    points_to_csv,
    points_to_json,
    project_object_points,
    track_points,
)
from tracking3d.results.point_tracking import open_scene
from tracking3d.results.point_trails import draw_trails, write_trails
from tracking3d.results.run_reader import RunReader, open_run_source
from tracking3d.runtime.progress import StageProgress, listen_to_progress
from tracking3d.video import open_source

SHAKEN = 1.5  # degrees


@pytest.fixture(scope="module")
def shaken(tmp_path_factory, make_turning_sphere, write_run):
    """A run whose poses are off, the sphere's clip, and the true poses."""
    clip = make_turning_sphere(8, step=4.0)
    rng = np.random.default_rng(5)
    estimates, truth = [], []
    for estimate in clip.estimates:
        T = estimate.T_cam_obj.copy()
        truth.append(estimate.T_cam_obj)
        turn = rng.normal(size=3)
        T[:3, :3] = (
            Rotation.from_rotvec(np.deg2rad(SHAKEN) * turn / np.linalg.norm(turn)).as_matrix() @ T[:3, :3]
        )
        estimates.append(dataclasses.replace(estimate, T_cam_obj=T))
    folder = tmp_path_factory.mktemp("shaken") / "run"
    write_run(folder, dataclasses.replace(clip, estimates=estimates))
    return folder, clip, truth


def source(clip):
    return open_source([frame.image for frame in clip.frames])


@pytest.fixture(scope="module")
def scene(shaken):
    folder, clip, _ = shaken
    return open_scene(folder, source(clip))


def true_positions(clip, truth, xy):
    """Where the points of a unit sphere under pixels of frame 0 are."""
    camera, T = clip.camera, truth[0]
    ray = np.stack(
        [(xy[:, 0] - camera.cx) / camera.fx, (xy[:, 1] - camera.cy) / camera.fy, np.ones(len(xy))], 1
    )
    t = T[:3, 3]
    a, b, c = (ray**2).sum(1), ray @ t, t @ t - 1
    points = ((b - np.sqrt(b * b - a * c)) / a)[:, None] * ray - t
    return np.stack([project_object_points(camera, one, points @ T[:3, :3])[0] for one in truth])


def test_the_images_put_right_what_the_poses_have_wrong(shaken, scene):
    folder, clip, truth = shaken
    left, top = project_object_points(clip.camera, truth[0], np.zeros((1, 3)))[0][0]
    xy = np.stack(np.meshgrid(left + np.arange(-15, 16, 6), top + np.arange(-15, 16, 6)), -1).reshape(-1, 2)
    exact = true_positions(clip, truth, xy)
    by_mesh, corrected = track_points(folder, 0, xy), scene.track(0, xy)
    before, after = (np.linalg.norm(one.positions - exact, axis=2)[1:] for one in (by_mesh, corrected))
    assert np.median(before) > 0.5
    assert np.median(after) < 0.5 * np.median(before)
    assert corrected.measured[1:].mean() > 0.8
    assert corrected.visible.all()
    assert (after < 2 * corrected.uncertainty[1:]).mean() > 0.8
    assert np.allclose(corrected.positions[0], xy)
    assert np.isfinite(corrected.points).all()


def test_points_beside_the_object_have_no_track_and_those_on_its_rim_have(shaken, scene):
    _, clip, truth = shaken
    rim = project_object_points(clip.camera, truth[0], np.zeros((1, 3)))[0][0] + (clip.camera.fx / 4 + 0.5, 0)
    tracks = scene.track(0, [[1, 1], rim, [1e6, 0]])
    assert tracks.on_object.tolist() == [False, True, False]
    assert tracks.face[0] == tracks.face[2] == -1
    assert np.isnan(tracks.positions[:, [0, 2]]).all()
    assert not tracks.visible[:, [0, 2]].any()
    assert np.isnan(tracks.uncertainty[:, 0]).all()


def test_landmarks_are_kept_and_belong_to_their_run(shaken, scene):
    folder, clip, _ = shaken
    file = folder / layout.LANDMARKS
    assert file in layout.run_files(folder)
    heard = []
    with listen_to_progress(heard.append):
        again = open_scene(folder, source(clip))
    assert {progress.name for progress in heard} == {"reading frames"}
    assert np.allclose(again.scene.vertices, scene.scene.vertices)
    for one, other in zip(again.scene.views, scene.scene.views, strict=True):
        assert np.allclose(one.T_cam_obj, other.T_cam_obj)
        assert np.allclose(one.inverse_depth, other.inverse_depth)
    file.write_bytes(b"damaged")
    with listen_to_progress(heard.append):
        open_scene(folder, source(clip), rounds=1)
    assert StageProgress("refining poses", 1, 1) in heard
    untouched = open_scene(folder, source(clip), rounds=0)
    assert np.allclose(untouched.scene.views[1].T_cam_obj, RunReader(folder).frames[1].T_cam_obj)


def test_a_video_that_is_not_the_run_s_is_refused(shaken):
    folder, clip, _ = shaken
    run = RunReader(folder)
    with pytest.raises(InputError, match="--source"):
        open_run_source(run)
    small = [frame.image[::2, ::2] for frame in clip.frames]
    with pytest.raises(InputError, match="80 x 60 pixels"):
        open_scene(run, open_source(small))


def test_a_grid_lies_on_the_object(shaken):
    run = RunReader(shaken[0])
    pixels = np.array(grid_on_object(run, 0, 8))
    assert 20 < len(pixels) < 120
    assert run.mask(0)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].mean() > 0.9
    with pytest.raises(InputError, match="smaller --grid"):
        grid_on_object(run, 0, 1000)


def test_files_and_pictures_hold_what_is_known(shaken, scene, tmp_path):
    _, clip, truth = shaken
    middle = project_object_points(clip.camera, truth[0], np.zeros((1, 3)))[0][0]
    tracks = scene.track(0, [middle, [1, 1]])
    rows = list(csv.DictReader(io.StringIO(points_to_csv(tracks))))
    assert list(rows[0]) == COLUMNS
    assert float(rows[2]["uncertainty"]) == pytest.approx(tracks.uncertainty[1, 0], abs=1e-3)
    assert [rows[1][name] for name in ("x", "uncertainty", "X")] == ["", "", ""]
    image = np.full((120, 160, 3), 40, np.uint8)
    drawn = draw_trails(image, tracks, 3)
    factor = drawn.shape[0] // 120
    x, y = ((tracks.positions[3, 0] + 0.5) * factor).astype(int)
    assert drawn[y, x].max() == 255
    assert (drawn != 40).any(2).mean() < 0.02
    write_trails(tmp_path / "trails.mp4", clip.frames, tracks, 25.0)
    frames = list(open_source(tmp_path / "trails.mp4"))
    assert len(frames) == 8


def test_estimates_that_landmarks_adjusted_are_taken_as_they_are(shaken, tmp_path):
    folder, clip, _ = shaken
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    (run / layout.LANDMARKS).unlink(missing_ok=True)
    lines = [json.loads(line) for line in (run / layout.FRAMES).read_text().splitlines()]
    for line in lines:
        line["refined"] = True
        line["diagnostics"] = {**line["diagnostics"], "landmark_matches": 40.0, "landmark_inliers": 38.0}
    (run / layout.FRAMES).write_text("".join(json.dumps(line) + "\n" for line in lines))
    heard = []
    with listen_to_progress(heard.append):
        taken = open_scene(run, source(clip))
    assert {progress.name for progress in heard} == {"reading frames"}
    for view, record in zip(taken.scene.views, RunReader(run).frames, strict=True):
        assert np.allclose(view.T_cam_obj, record.T_cam_obj)


TO_OTHER = Similarity(
    Rotation.from_euler("xyz", [40, -70, 20], degrees=True).as_matrix(), 1.7, np.array([0.3, -0.2, 0.5])
)


@pytest.mark.parametrize("frames", [slice(2, 10), slice(4, None, -1)], ids=["forwards", "backwards"])
def test_points_are_found_in_another_run_of_the_object(
    shaken, scene, make_turning_sphere, write_run, tmp_path, frames
):
    """Its object coordinates, pictures and first view are others; its poses are right, those of the run are off."""
    folder, clip, truth = shaken
    other = make_turning_sphere(12, step=5.0)
    shown = [dataclasses.replace(one, index=n) for n, one in enumerate(other.frames[frames])]
    poses = [one.T_cam_obj for one in other.estimates[frames]]
    estimates = [
        dataclasses.replace(one, index=n, T_cam_obj=TO_OTHER.poses(one.T_cam_obj[None])[0])
        for n, one in enumerate(other.estimates[frames])
    ]
    model = dataclasses.replace(other.model, vertices=TO_OTHER.points(other.model.vertices))
    write_run(tmp_path / "other", dataclasses.replace(other, model=model, frames=shown, estimates=estimates))
    there = open_scene(tmp_path / "other", open_source([one.image for one in shown]))
    xy = np.array(grid_on_object(RunReader(folder), 0, 8))
    found = scene.track_in(there, TO_OTHER, 0, xy)
    expected = true_positions(clip, [truth[0], *poses], xy)[1:]
    assert found.on_object.all() and list(found.frames) == list(range(len(shown)))
    error = np.linalg.norm(found.positions - expected, axis=2)[found.visible]
    assert found.visible.mean() > 0.8 and np.median(error) < 0.5  # 1.5 degrees are .8
    radii = np.linalg.norm(TO_OTHER.inverse.points(found.points), axis=1)
    np.testing.assert_allclose(radii, 1, atol=0.1)

    own = scene.track(0, xy)
    rows = list(csv.DictReader(io.StringIO(points_to_csv(own, found))))
    assert [row["run"] for row in rows] == ["0"] * own.visible.size + ["1"] * found.visible.size
    assert float(rows[-1]["x"]) == pytest.approx(found.positions[-1, -1, 0], abs=1e-3)
    assert json.loads(points_to_json(own, found))["other"]["visible"] == found.visible.tolist()
    with pytest.raises(InputError, match="no frame 99"):
        scene.track_in(there, TO_OTHER, 99, xy)
