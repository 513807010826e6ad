"""Points of a run in which landmarks were found are scored twice: by the mesh alone, and as the images correct them."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation
from turning_sphere import turning_sphere_of, written_run

from tracking3d.results import layout
from tracking3d.results.point_tracking import has_landmarks, open_scene
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import write_clip
from tracking3d.video import open_source
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.datasets.run_answers import answers_of_run
from tracking3d_bench.datasets.truth import PointTruth, Truth
from tracking3d_bench.evaluation.point_tracks import score_points
from tracking3d_bench.evaluation.score import Scores, score
from tracking3d_bench.evaluation.score_table import format_scores

FRAMES = 8


@pytest.fixture(scope="module")
def sphere():
    return turning_sphere_of(FRAMES, step=4.0)


@pytest.fixture(scope="module")
def truth(sphere, tmp_path_factory) -> Truth:
    """The sphere's clip, and 30 points of its front."""
    folder = tmp_path_factory.mktemp("truth") / "clip"
    images, masks = (
        np.stack([one.image for one in sphere.frames]),
        np.stack([one.mask for one in sphere.estimates]),
    )
    poses = np.stack([one.T_cam_obj for one in sphere.estimates])
    write_clip(folder, images, masks, poses, sphere.camera, source="hand", note="")
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (30, 2)), np.zeros(30)])
    points[:, 2] = -np.sqrt(1 - (points**2).sum(1))
    points = points @ poses[4, :3, :3]  # as seen from the front in the middle of the clip
    seen = np.stack([points @ T[:3, :3].T + T[:3, 3] for T in poses])
    pixels = seen @ sphere.camera.K.T
    positions = pixels[..., :2] / pixels[..., 2:]
    return dataclasses.replace(
        read_truth(folder), points=PointTruth(positions, np.ones(positions.shape[:2], bool))
    )


@pytest.fixture
def run(sphere, tmp_path) -> RunReader:
    """A run whose poses are off by two degrees."""
    rng = np.random.default_rng(5)
    estimates = []
    for estimate in sphere.estimates:
        T, turn = estimate.T_cam_obj.copy(), rng.normal(size=3)
        off = Rotation.from_rotvec(np.deg2rad(2) * turn / np.linalg.norm(turn)).as_matrix()
        T[:3, :3] = off @ T[:3, :3]
        estimates.append(dataclasses.replace(estimate, T_cam_obj=T))
    written_run(tmp_path / "run", dataclasses.replace(sphere, estimates=estimates))
    return RunReader(tmp_path / "run")


def find_landmarks(run, sphere):
    open_scene(run, open_source([frame.image for frame in sphere.frames]))


def table(scores: Scores) -> str:
    console = Console(record=True, width=120, file=io.StringIO())
    console.print(format_scores(scores))
    return console.export_text()


def test_without_landmarks_the_mesh_alone_is_scored(run, truth):
    assert not has_landmarks(run)
    scores = score(answers_of_run(run.folder, truth), truth)
    assert scores.points == 30 and 0 < scores.points_delta_average < 1
    assert scores.points_corrected_delta_average is None
    assert "points: share within" in table(scores) and "corrected" not in table(scores)


def test_with_landmarks_both_are_scored_and_named(run, sphere, truth):
    before = score(answers_of_run(run.folder, truth), truth)
    find_landmarks(run, sphere)
    assert has_landmarks(run)
    scores = score(answers_of_run(run.folder, truth), truth)
    assert scores.points_delta_average == before.points_delta_average
    assert scores.points_corrected_delta_average > scores.points_delta_average + 0.05
    assert scores.points_corrected_average_jaccard > scores.points_average_jaccard + 0.05
    assert scores.points_corrected_occlusion_accuracy > 0.9
    said = table(scores)
    assert "points from the mesh alone: share within 1 to 16 px" in said
    assert "points corrected by images: share within 1 to 16 px" in said


def test_landmarks_of_other_poses_do_not_count(run, sphere, truth):
    find_landmarks(run, sphere)
    file = run.folder / layout.LANDMARKS
    with np.load(file) as kept:
        other = {**kept, "key": np.array("of another run")}
    np.savez(file, **other)
    assert not has_landmarks(run)
    assert answers_of_run(run.folder, truth).corrected_points is None
    file.write_bytes(b"damaged")
    assert not has_landmarks(run)


@pytest.mark.parametrize("offset", [2, -2])
def test_a_run_that_begins_elsewhere_than_the_clip_gets_the_clip_s_images(run, sphere, truth, offset):
    find_landmarks(run, sphere)
    aligned = answers_of_run(run.folder, truth).corrected_points
    frames = [truth.frames[0]] * max(offset, 0) + list(truth.frames[max(-offset, 0) :])
    cut = dataclasses.replace(truth, frames=frames, points=None)
    shifted = answers_of_run(run.folder, cut, offset=offset).corrected_points
    xy = truth.points.positions[3, :5]
    expected, found = aligned(3, xy)[0], shifted(3 + offset, xy)[0]
    # Run frames before the clip are unknown then, which may move the landmarks' points a little.
    np.testing.assert_allclose(found[4 + offset], expected[4], atol=0.3)


def test_other_methods_points_are_just_points(truth, run):
    answers = answers_of_run(run.folder, truth)
    assert score_points(dataclasses.replace(answers, points=None), truth).points == 0
