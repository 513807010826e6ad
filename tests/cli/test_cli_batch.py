"""``tracking3d batch``: what it takes, prints and keeps, and how it ends."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tracking3d.engines.choosing import InThisProcess
from tracking3d.engines.protocol import Needs
from tracking3d.video import VideoWriter

BOX = "20,10,20,20"


@pytest.fixture
def opened(monkeypatch):
    """Work in this process, and what was asked for instead."""
    asked = []

    @contextmanager
    def here(address=None, workers=None, needs=None):
        asked.append((address, workers, needs))
        yield InThisProcess()

    monkeypatch.setattr("tracking3d.engines.choosing.open_engine", here)
    monkeypatch.setattr("tracking3d.batch.running.PAUSE", 0.0)
    return asked


@pytest.fixture
def shots(clip, tmp_path):
    """Two folders of images, of one of which nothing is said."""
    folder = tmp_path / "shots"
    for name in ("cup", "plate"):
        shutil.copytree(clip, folder / name)
    (folder / "cup.box").write_text(BOX)
    return folder


@pytest.fixture
def table(shots, tmp_path):
    """Both with an object, and settings in a row of one."""
    file = tmp_path / "jobs.csv"
    file.write_text(
        f'video,box,settings,fov\nshots/cup,"{BOX}",runtime.seed=5,\nshots/plate,"{BOX}; 5,5,9,9",,40\n'
    )
    return file


def test_the_line_of_the_readme_works_with_what_the_readme_says(call, clip, tmp_path, script, opened):
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"`tracking3d (batch clips/ --out runs)`", readme)
    file, line, video = re.search(r"`(clips/\S+\.box)` with the line `(\S+)` for `(\S+)`", readme).groups()
    (tmp_path / "clips").mkdir()
    with VideoWriter(tmp_path / video, 10, (480, 640)) as writer:
        for _ in range(3):
            writer.write(np.zeros((480, 640, 3), np.uint8))
    (tmp_path / file).write_text(line + "\n")
    result = call(*command.split(), "--no-report")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "runs" / Path(video).stem / "run.json").is_file()
    assert [prompt.box for _, prompt in script.built] == [tuple(map(int, line.split(",")))]


def test_a_folder_of_videos_without_any_box_is_refused_at_once(refused, shots, opened):
    (shots / "cup.box").unlink()
    for name in ("one", "two"):
        (shots / f"{name}.mp4").touch()
    line = refused("batch", shots, "--out", "out")
    assert f"None of the 2 videos of {shots} has a box" in line and f"{shots / 'one.box'}" in line
    assert opened == [] and not Path("out").exists()
    (shots / "two.mp4").unlink()
    assert "The only video" in refused("batch", shots, "--out", "out")


def test_videos_without_a_box_are_named_before_the_others_are_tracked(call, shots, script, opened):
    for number in range(7):
        (shots / f"bare_{number}.mp4").touch()
    result = call("batch", shots, "--out", "out", "--no-report", "--retries", 0)
    assert result.exit_code == 1
    first = result.stderr.splitlines()[0]
    assert first.startswith("7 of 8 videos have no box and will fail (bare_0, bare_1, bare_2, bare_3, bare_4")
    assert "bare_4 and 2 more)" in first
    assert len(script.built) == 1


def test_a_row_has_its_own_quality_and_final_mesh(call, shots, tmp_path, script, opened, monkeypatch):
    monkeypatch.setattr("tracking3d.pipeline.record.make_final_shape", lambda *_: "")
    table = tmp_path / "jobs.csv"
    table.write_text(f'video,box,quality,model\nshots/cup,"{BOX}",best,none\nshots/plate,"{BOX}",,\n')
    result = call("batch", table, "--out", "out", "--no-report", "--model", "fine")
    assert result.exit_code == 0, result.output
    made = {
        config.crop.size: (config.object.shape, config.object.texture_views) for config, _ in script.built
    }
    assert made == {192: ("fast", 0), 128: ("fine", 24)}


def test_a_row_with_a_final_mesh_for_its_quality_fails_alone(call, shots, tmp_path, script, opened):
    table = tmp_path / "jobs.csv"
    table.write_text(f'video,box,quality\nshots/cup,"{BOX}",fine\nshots/plate,"{BOX}",\n')
    result = call("batch", table, "--out", "out", "--no-report", "--retries", 0)
    assert result.exit_code == 1 and len(script.built) == 1
    assert "fine is a value of model" in result.output


def test_a_table_is_tracked_with_the_settings_of_its_rows(call, table, script, opened):
    result = call("batch", table, "--out", "out", "--no-report", "--set", "crop.size=64", "--threads", 2)
    assert result.exit_code == 0, result.output
    assert opened == [(None, None, Needs(2, 0.0, 0.0))]
    (cup, _), *plate = sorted(script.built, key=lambda one: one[0].runtime.seed != 5)
    assert (cup.runtime.seed, cup.crop.size, cup.runtime.threads) == (5, 64, 2)
    assert [config.camera.fov for config, _ in plate] == [40, 40]
    assert [prompt.box for _, prompt in plate] == [(20, 10, 20, 20), (5, 5, 9, 9)]
    assert "cup: 5 frames" in result.stderr and "2 of 2 videos" in result.stderr

    status = call("batch", "status", "out")
    assert status.exit_code == 0 and "finished" in status.stdout and "2 of 2 videos" in status.stdout
    again = call("batch", table, "--out", "out", "--no-report", "--set", "crop.size=64", "--threads", 2)
    assert again.exit_code == 0 and len(script.built) == 3 and "2 of them earlier" in again.stderr


def test_events_are_lines_of_json_and_a_failure_is_the_exit_code(call, shots, script, opened):
    script.faults[3] = RuntimeError("the solver has a fault")
    result = call("batch", shots / "*", "--out", "out", "--json", "--retries", 1, "--no-report")
    assert result.exit_code == 1
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert [event["event"] for event in events if event["video"] == "plate"] == ["failed"]
    of_cup = [event["event"] for event in events if event["video"] == "cup" and event["event"] != "progress"]
    assert of_cup == ["began", "again", "began", "failed"]
    assert events[-1]["event"] == "batch" and events[-1]["batch"]["failed"] == 2
    told = json.loads(call("batch", "status", "out", "--json").stdout)
    reasons = {failure["run"]: failure["reason"] for failure in told["failures"]}
    assert "the solver has a fault" in reasons["cup"] and "plate.box" not in reasons
    assert "VIDEO.box" in reasons["plate"]


def test_ctrl_c_says_that_the_same_command_goes_on(call, shots, script, opened):
    script.faults[2] = KeyboardInterrupt()
    result = call("batch", shots, "--out", "out", "--quiet", "--no-report")
    assert result.exit_code == 130 and "To continue the batch, repeat the command." in result.stderr
    assert "interrupted" in call("batch", "status", "out").stdout
    script.faults.clear()
    assert call("batch", shots, "--out", "out", "--quiet", "--no-report").exit_code == 0


def test_a_dataset_is_tracked_from_its_boxes(call, tmp_path, script, opened):
    from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize, write_clip

    clip = synthesize(SyntheticSpec(frames=2, size=(64, 48), supersample=1))
    for name in ("one", "two"):
        poses, camera = clip.T_cam_obj, clip.camera
        write_clip(tmp_path / "clips" / name, clip.images, clip.masks, poses, camera, source="test", note="")
    arguments = ("batch", "real", "--data", "clips", "--sequence", "t*", "--out", "out", "--no-report")
    assert call(*arguments).exit_code == 0
    [(config, prompt)] = script.built
    assert config.camera.intrinsics[0] == pytest.approx(clip.camera.fx) and prompt.box[2] > 0
    assert (tmp_path / "out/two/batch.json").is_file()


def test_what_cannot_be_used_is_said_before_anything_is_written(refused, shots, tmp_path):
    (tmp_path / "jobs.csv").write_text("video,wdith\nshots/cup,3\n")
    assert "'wdith'" in refused("batch", "jobs.csv", "--out", "out")
    assert "contains no video" in refused("batch", "absent/*.mp4", "--out", "out")
    assert "progress.json" in refused("batch", "status", "shots")
    assert "no setting" in refused("batch", shots, "--out", "out", "--set", "solver.nothing=1")
    assert not (tmp_path / "out").exists()
