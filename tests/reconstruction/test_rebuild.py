"""A run that exists gets the texture of its video; what cannot be is said, and its mesh stays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_views import CAMERA, SIDE, ball, pattern, pose, seen
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.frames import Frame
from tracking3d.reconstruction import rebuild
from tracking3d.reconstruction.rebuild import rebuild_shape, retexture_run
from tracking3d.reconstruction.shape import ReconstructedShape
from tracking3d.results import redrawing
from tracking3d.results.checkpoint.progress import checksum
from tracking3d.results.description import RunHeader
from tracking3d.results.files import write_image
from tracking3d.results.mesh_export import find_seen_vertices, load_model
from tracking3d.results.run_writer import RunWriter
from tracking3d.ui.report import run_report
from tracking3d.ui.report.run_report import write_report

YAWS = (0, 15, 30)


def written(folder: Path, yaws=YAWS, **changes) -> Path:
    """A finished run of a few frames, and its frames beside it."""
    images = folder / "frames"
    images.mkdir(parents=True)
    estimates, frames = [], []
    for index, yaw in enumerate(yaws):
        image, mask = seen(pose(yaw), pattern())
        write_image(images / f"{index:03d}.png", image)
        frames.append(Frame(index, image, index / 30, f"{index:03d}.png"))
        one = FrameEstimate(index, index / 30, pose(yaw), mask, mask, Status.TRACKED, "", 0.9)
        estimates.append(replace(one, **changes))
    given = {"first_frame": 0, "first_image_crc": checksum(frames[0].image)}
    run = folder / "run"
    header = RunHeader(
        config={}, camera=CAMERA, source=str(images), seed=0, fps=None, command=None, prompt=given
    )
    with RunWriter(run, header) as writer:
        for frame, estimate in zip(frames, estimates, strict=True):
            writer.write(estimate, frame)
        writer.finish(ball(), "finished")
    return run


def test_the_mesh_has_the_texture_of_the_video(tmp_path):
    run = written(tmp_path)
    before = load_model(run)
    made, taken = retexture_run(run)
    after = load_model(run)
    assert taken == len(YAWS)
    assert len(before.texture) == 16 < len(after.texture) == len(made.texture)
    assert (after.texture == made.texture).all() and (after.texture_weight == made.texture_weight).all()
    assert after.texture[after.texture_weight > 0.3].std() > 20
    seen = find_seen_vertices(after)
    assert seen.any() and (after.vertices == before.vertices)[seen].all(), "what no frame shows is closed"


def test_the_video_may_have_moved(tmp_path):
    run = written(tmp_path)
    (tmp_path / "frames").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="frames"):
        retexture_run(run)
    assert retexture_run(run, str(tmp_path / "elsewhere"), most=2)[1] == 2


def test_another_video_is_refused(tmp_path):
    run = written(tmp_path)
    for name, image, words in [
        ("other", np.zeros((SIDE, SIDE, 3), np.uint8), "does not begin as the video"),
        ("small", np.zeros((20, 30, 3), np.uint8), "30 x 20 pixels"),
    ]:
        (tmp_path / name).mkdir()
        write_image(tmp_path / name / "000.png", image)
        with pytest.raises(InputError, match=words):
            retexture_run(run, str(tmp_path / name))
    assert len(load_model(run).texture) == 16


@pytest.mark.parametrize("changes", [{"status": Status.UNCERTAIN}, {"status": Status.LOST}])
def test_if_no_frame_is_tracked_the_mesh_stays(tmp_path, changes):
    run = written(tmp_path, **changes)
    with pytest.raises(InputError, match="its mesh stays as it is"):
        retexture_run(run)
    assert len(load_model(run).texture) == 16


def test_the_command_says_what_it_did(tmp_path):
    run = written(tmp_path)
    result = CliRunner().invoke(app, ["model", str(run), "--largest", "128"])
    assert result.exit_code == 0
    assert "texture of 128 x 128 texels from 3 frames" in result.output.replace("\n", "")
    assert len(load_model(run).texture) == 128
    assert CliRunner().invoke(app, ["model", str(tmp_path / "absent")]).exit_code == 2


def sheet_of(run: Path) -> np.ndarray:
    image = cv2.imread(str(run / "contact_sheet.png"))
    assert image is not None
    return image


def new_shape(monkeypatch) -> None:
    """Let the reconstruction find a sphere of half the size."""
    made = ReconstructedShape(ball().vertices * 0.5, ball().faces, "it is better", None, None)
    monkeypatch.setattr(rebuild, "reconstruct_shape", lambda starts, views, left_out: made)


@pytest.mark.parametrize(
    "has",
    [["report.html", "turntable.mp4"], ["report.html"], ["turntable.mp4"], []],
    ids=lambda has: " and ".join(has) or "neither",
)
def test_what_shows_the_mesh_is_made_again_if_the_run_has_it(tmp_path, monkeypatch, has):
    monkeypatch.setattr(run_report, "VIEWS", 3)
    run = written(tmp_path)
    new_shape(monkeypatch)
    if has:
        write_report(run)
    for name in {"report.html", "turntable.mp4"} - set(has):
        (run / name).unlink(missing_ok=True)
    before = {name: (run / name).read_bytes() for name in has}
    result = CliRunner().invoke(app, ["model", str(run), "--model", "fine"])
    assert result.exit_code == 0, result.output
    after = {name: (run / name).read_bytes() for name in has}
    assert all(after[name] != before[name] for name in has)
    assert {path.name for path in run.iterdir()} & {"report.html", "turntable.mp4"} == set(has)
    assert all(name in result.output for name in has)


def test_the_contact_sheet_shows_the_new_mesh_and_the_same_crops(tmp_path, monkeypatch):
    run = written(tmp_path)
    new_shape(monkeypatch)
    before, read = sheet_of(run), list[str]()
    monkeypatch.setattr(redrawing, "open_source", lambda path: read.append(path) or iter(()))
    rebuild_shape(run)
    after = sheet_of(run)
    assert not read, "crops are not taken from the overlay once more"
    tile = after.shape[1] // 6
    assert before.shape[1] == after.shape[1]
    crops = np.s_[:tile, : 3 * tile]  # three frames; then texture and model in the next row
    assert np.array_equal(before[crops], after[crops])
    model = np.s_[tile : 2 * tile, tile : 2 * tile]
    assert np.abs(before[model].astype(int) - after[model]).mean() > 5
    (run / "contact_sheet.png").unlink()
    retexture_run(run)
    assert not (run / "contact_sheet.png").exists(), "a run without one does not get one"


def test_the_notes_speak_of_the_new_mesh(tmp_path, monkeypatch):
    run = written(tmp_path)
    path = run / "run.json"
    stale = "90 % of the mesh's surface was never seen and is a guess"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"notes": [stale]}))
    retexture_run(run)
    assert stale not in json.loads(path.read_text())["notes"]


def test_a_shape_that_cannot_be_told_leaves_the_mesh_and_its_texture(tmp_path):
    run = written(tmp_path)
    result = CliRunner().invoke(app, ["model", str(run), "--model", "fine"])
    assert result.exit_code == 0, result.output
    assert "The mesh keeps its shape: only" in result.output
    assert len(load_model(run).texture) > 16 and not (run / "online").exists()


def test_a_new_shape_takes_the_place_of_the_old_one_which_is_kept(tmp_path, monkeypatch):
    run = written(tmp_path)
    before, smaller = load_model(run), ball().vertices * 0.97
    made = ReconstructedShape(smaller, ball().faces, "it is better", None, None)
    monkeypatch.setattr(rebuild, "reconstruct_shape", lambda starts, views, left_out: made)
    shaped = rebuild_shape(run)
    after = load_model(run)
    assert shaped.new and shaped.views == len(YAWS)
    shown = find_seen_vertices(after)
    np.testing.assert_array_equal(after.vertices[shown], smaller[shown])
    assert after.seen.any() and not after.seen.all()
    assert after.features.shape == before.features.shape
    assert after.texture[after.texture_weight > 0.3].std() > 20
    np.testing.assert_array_equal(load_model(run / "online").vertices, before.vertices)
    retexture_run(run)  # the fast model again
    again = load_model(run)
    shown = find_seen_vertices(again)
    np.testing.assert_array_equal(again.vertices[shown], before.vertices[shown])


def test_without_a_texture_from_the_video_the_online_mesh_comes_back_as_it_was(tmp_path, monkeypatch):
    run = written(tmp_path)
    files = {
        path: path.read_bytes() for path in (run / "mesh.obj", run / "features.npz", run / "texture.png")
    }
    result = CliRunner().invoke(app, ["model", str(run), "--model", "none"])
    assert result.exit_code == 0 and "stays as it is" in result.output
    assert {path: path.read_bytes() for path in files} == files
    made = ReconstructedShape(ball().vertices * 0.97, ball().faces, "it is better", None, None)
    monkeypatch.setattr(rebuild, "reconstruct_shape", lambda starts, views, left_out: made)
    before = load_model(run)
    rebuild_shape(run)
    result = CliRunner().invoke(app, ["model", str(run), "--model", "none"])
    assert result.exit_code == 0 and "the online mesh again" in result.output.replace("\n", " ")
    np.testing.assert_array_equal(load_model(run).vertices, before.vertices)
    np.testing.assert_array_equal(load_model(run).texture, before.texture)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    run = written(tmp_path)
    monkeypatch.setattr(rebuild, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="needs scikit-image"):
        rebuild_shape(run)
    assert len(load_model(run).texture) == 16


def test_the_model_is_judged_by_a_frame_that_its_texture_has_not_seen(tmp_path):
    run = written(tmp_path, yaws=(0, 8, 16, 24, 32, 40))
    before = (run / "texture.png").read_bytes()
    result = CliRunner().invoke(app, ["evaluate", "model", str(run), "--json"])
    assert result.exit_code == 0, result.output
    (scores,) = json.loads(result.stdout).values()
    assert scores["frames"] == 1 and scores["psnr"] > 20 and 0.7 < scores["ssim"] <= 1
    assert (run / "texture.png").read_bytes() == before
    table = CliRunner().invoke(app, ["evaluate", "model", str(run)])
    assert f"{scores['psnr']:.2f} dB" in table.stdout and "genus" not in table.stdout


def test_what_models_are_judged_by_has_to_be_there(tmp_path):
    run = written(tmp_path)
    for options, words in [
        ([], "none can be held out"),
        (["--truth", str(tmp_path), "--truth", str(tmp_path)], "--truth is given 2 times for 1 runs"),
    ]:
        result = CliRunner().invoke(app, ["evaluate", "model", str(run), *options])
        assert result.exit_code == 2 and words in " ".join(result.output.replace("│", " ").split())
