"""Two videos of one object: how it lies in one is found from the other, and the frames of both make its model."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rendered_views import CAMERA, ball, pattern, pose, seen
from scipy.spatial.transform import Rotation
from test_rebuild import written
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import InputError
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction import extension
from tracking3d.reconstruction.extension import check_earlier_run, extend_run, fit_points, register_run
from tracking3d.reconstruction.rebuild import EXTENDS
from tracking3d.reconstruction.run_views import shows_other_side, surface_keypoints
from tracking3d.results.mesh_export import export_mesh, find_seen_faces, load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import scale_run, unit_scale
from tracking3d.scene.view import ObjectView

TO_OWN = Similarity(
    Rotation.from_euler("xyz", [40, -70, 20], degrees=True).as_matrix(), 1.7, np.array([0.3, -0.2, 0.5])
)
"""From the coordinates of the other run to those of the run."""


SAME = {"R": np.eye(3).tolist(), "scale": 1.0, "translation": [0, 0, 0]}


def noted(run, note):
    path = run / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), EXTENDS: note}))


def in_own(T_cam_other):
    return TO_OWN.poses(T_cam_other[None])[0]


def own_ball():
    model = ball()
    return replace(model, vertices=TO_OWN.points(model.vertices))


def frames(yaws, model, place=lambda T: T, texture=None):
    found = []
    for yaw in yaws:
        image, mask = seen(pose(yaw), pattern() if texture is None else texture)
        found.append(surface_keypoints(ObjectView.of_frame(0, image, mask, CAMERA, place(pose(yaw))), model))
    return found


def angle(A, B) -> float:
    return float(np.degrees(Rotation.from_matrix(A.T @ B).magnitude()))


def test_three_points_give_the_similarity_exactly():
    points = np.random.default_rng(0).normal(size=(3, 3))
    found = fit_points(TO_OWN.points(points), points)
    np.testing.assert_allclose(found.R, TO_OWN.R, atol=1e-9)
    np.testing.assert_allclose(
        [found.scale, *found.translation], [TO_OWN.scale, *TO_OWN.translation], atol=1e-9
    )
    assert np.linalg.det(fit_points(points, points * (-1, 1, 1)).R) > 0
    assert fit_points(np.outer(np.arange(3), (1, 2, 3.0)), np.outer(np.arange(3), (1, 0, 0.0))) is None


def test_keypoints_lie_on_the_surface():
    [view] = frames([20], ball())
    assert len(view.points) > 30
    np.testing.assert_allclose(np.linalg.norm(view.points, axis=1), 1, atol=0.03)
    projected = view.points @ view.P[:, :3].T + view.P[:, 3]
    np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], view.keypoints.pixel, atol=1e-3)


def test_frames_that_are_alike_are_not_kept_twice():
    kept = frames([0, 30], ball())
    assert not shows_other_side(kept, pose(3)) and shows_other_side(kept, pose(15))


def test_the_similarity_is_found_from_both_videos():
    own, other = frames(range(0, 50, 10), own_ball(), in_own), frames(range(5, 55, 10), ball())
    found = register_run(own, other)
    assert angle(found.similarity.R, TO_OWN.R) < 0.3
    assert found.similarity.scale == pytest.approx(TO_OWN.scale, rel=0.01)
    np.testing.assert_allclose(found.similarity.translation, TO_OWN.translation, atol=0.02)
    assert found.matches >= 30 and found.error < 1


@pytest.mark.parametrize(
    "other", [[], frames([0, 10, 20], ball(), texture=pattern(seed=6))], ids=["no frames", "another object"]
)
def test_what_shows_nothing_in_common_is_refused(other):
    with pytest.raises(InputError, match="too little of the object in common"):
        register_run(frames([0, 10, 20], own_ball(), in_own), other)


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory) -> tuple[Path, Path]:
    """A run of some sides, in coordinates of its own, and an earlier one of others."""
    folder = tmp_path_factory.mktemp("runs")
    earlier = written(folder / "a", range(-80, 12, 6))
    run = written(folder / "b", range(-20, 80, 6))
    lines = (run / "frames.jsonl").read_text().splitlines()
    moved = [json.loads(line) for line in lines]
    for line in moved:
        line["T_cam_obj"] = in_own(np.array(line["T_cam_obj"]).reshape(4, 4)).tolist()
    (run / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in moved))
    export_mesh(run, own_ball())
    return run, earlier


def seen_share(run: Path) -> float:
    return float(find_seen_faces(load_model(run)).mean())


@pytest.mark.slow
def test_the_model_shows_the_sides_of_both_videos(two_runs, tmp_path):
    run, earlier = shutil.copytree(two_runs[0], tmp_path / "run"), two_runs[1]
    before = {path: path.read_bytes() for path in earlier.rglob("*") if path.is_file()}
    done = extend_run(run, earlier, source=str(two_runs[0].parent / "frames"))
    assert done.shaped.new and angle(done.registration.similarity.R, TO_OWN.R) < 0.5
    alone = shutil.copytree(two_runs[0], tmp_path / "alone")
    CliRunner().invoke(app, ["model", str(alone), "--source", str(two_runs[0].parent / "frames"), "--quiet"])
    assert seen_share(run) > seen_share(alone) + 0.08
    radius = np.linalg.norm((load_model(run).vertices - TO_OWN.translation) / TO_OWN.scale, axis=1)
    assert np.median(np.abs(radius - 1)) < 0.05
    note = RunReader(run).description[EXTENDS]
    assert note["run"] == str(earlier.resolve()) and note["scale"] == pytest.approx(TO_OWN.scale, rel=0.01)
    assert {path: path.read_bytes() for path in earlier.rglob("*") if path.is_file()} == before


def test_a_run_that_extends_others_brings_their_frames_too(two_runs, tmp_path, monkeypatch):
    run, earlier = (
        shutil.copytree(two_runs[0], tmp_path / "run"),
        shutil.copytree(two_runs[1], tmp_path / "earlier"),
    )
    first = shutil.copytree(two_runs[1], tmp_path / "first")
    noted(earlier, {"run": str(first), **SAME})
    given = []

    def reshape(*arguments):
        given.append(arguments)
        raise InputError("That is enough.")

    monkeypatch.setattr(extension, "reshape_run", reshape)
    with pytest.raises(InputError, match="enough"):
        extend_run(run, earlier, source=str(two_runs[0].parent / "frames"))
    [(_, _, views, _, models, own)] = given
    assert len(models) == 2
    assert len({view.index for view in views.shapes}) == len(views.shapes)
    assert len(views.textures) > 2 * len(own)
    # All poses are in the run's coordinates: there the ball's centre projects to the middle of its mask.
    for view in views.shapes:
        x, y, z = view.P @ [*TO_OWN.translation, 1]
        middle = np.argwhere(view.mask).mean(0)[::-1]
        np.testing.assert_allclose((x / z, y / z), middle, atol=3)


def test_runs_that_extend_each_other_do_not_bring_the_same_frames_twice(two_runs, tmp_path):
    run, earlier = (shutil.copytree(one, tmp_path / one.parent.name) for one in two_runs)
    noted(earlier, {"run": str(run), **SAME})
    assert list(extension._runs_extended_by(RunReader(earlier), TO_OWN, 4, run)) == []


@pytest.mark.parametrize(
    "note",
    [
        3,
        {},
        {"run": 3},
        {"run": "x", **SAME, "R": [1, 2]},
        {"run": "x", **SAME, "scale": 0},
        {"run": "gone", **SAME},
    ],
)
def test_a_chain_ends_where_it_is_damaged(two_runs, tmp_path, note, caplog):
    earlier = shutil.copytree(two_runs[1], tmp_path / "earlier")
    noted(earlier, note)
    assert list(extension._runs_extended_by(RunReader(earlier), TO_OWN, 4, two_runs[0])) == []
    assert "without the runs that it extends itself" in caplog.text


def test_runs_that_are_put_into_metres_later_keep_their_similarity(two_runs, tmp_path):
    earlier, first = (shutil.copytree(two_runs[1], tmp_path / name) for name in ("earlier", "first"))
    noted(earlier, {"run": str(first), **SAME, "scale": 2.0, "translation": [0.1, 0.2, 0.3]})
    scale_run(earlier, 0.5)
    factor = unit_scale(RunReader(earlier))
    _, found = extension._parse_note(RunReader(earlier), RunReader(earlier).description[EXTENDS])
    assert found.scale == pytest.approx(2 * factor) and factor != 1
    np.testing.assert_allclose(found.translation, factor * np.array([0.1, 0.2, 0.3]))


def test_two_runs_share_coordinates_if_their_objects_have_one_origin(two_runs, tmp_path):
    names = ("first", "extending", "known", "known_again", "stranger")
    first, extending, known, again, stranger = (shutil.copytree(two_runs[1], tmp_path / one) for one in names)
    to_extending = {"R": TO_OWN.R.tolist(), "scale": 1.7, "translation": TO_OWN.translation.tolist()}
    noted(extending, {"run": str(first), **to_extending})
    for run in (known, again):
        description = json.loads((run / "run.json").read_text())
        description["config"] = {"object": {"model": str(first)}}
        (run / "run.json").write_text(json.dumps(description))

    def between(one, other):
        return extension.between_runs(RunReader(one), RunReader(other))

    points = np.random.default_rng(0).normal(size=(5, 3))
    for one, other, expected in (
        (known, again, points),
        (first, extending, TO_OWN.points(points)),
        (extending, known, TO_OWN.inverse.points(points)),
        (known, known, points),
    ):
        np.testing.assert_allclose(between(one, other).points(points), expected, atol=1e-9)
    with pytest.raises(InputError, match="share no object"):
        between(known, stranger)
    scale_run(first, 0.5)  # into metres, after the others were tracked
    factor = unit_scale(RunReader(first))
    np.testing.assert_allclose(between(known, first).points(points), factor * points)
    np.testing.assert_allclose(between(known, extending).points(points), TO_OWN.points(points))


def test_a_video_that_is_not_there_is_said_before_anything_is_tracked(two_runs, tmp_path):
    earlier = shutil.copytree(two_runs[1], tmp_path / "earlier")
    description = json.loads((earlier / "run.json").read_text())
    (earlier / "run.json").write_text(json.dumps({**description, "source": "gone.mp4"}))
    with pytest.raises(InputError, match="put it where its run"):
        check_earlier_run(earlier)


def test_a_mesh_that_is_made_again_from_one_video_forgets_the_other(two_runs, tmp_path):
    run = shutil.copytree(two_runs[0], tmp_path / "run")
    noted(run, {"run": str(two_runs[1]), **SAME})
    CliRunner().invoke(app, ["model", str(run), "--source", str(two_runs[0].parent / "frames"), "--quiet"])
    assert RunReader(run).description[EXTENDS] is None


def test_a_run_cannot_extend_itself(two_runs):
    with pytest.raises(InputError, match="cannot extend itself"):
        extend_run(two_runs[0], two_runs[0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--extend"], "by --object RUN"),
        (["--extend", "--object", "{mesh}"], "folder of an earlier run"),
        (
            ["--extend", "--object", "{run}", "--box", "1,1,9,9", "--box", "2,2,9,9"],
            "one model of one object",
        ),
    ],
)
def test_what_does_not_go_with_extend_is_said_before_anything_is_tracked(two_runs, tmp_path, options, words):
    run, _ = two_runs
    named = [option.format(mesh=run / "mesh.obj", run=run) for option in options]
    out = tmp_path / "out"
    said = CliRunner().invoke(app, ["run", str(run.parent / "frames"), "--out", str(out), *named])
    assert said.exit_code == 2 and words in said.output.replace("\n", " ")
    assert not out.exists()
