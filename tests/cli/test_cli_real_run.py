"""The whole program in a process of its own: a real run, one that is interrupted, and one that is killed."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import pytest
from forked import forked_program
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import make_demo_clip

QUICK = ["--size", "32", "--set", "object.frequency=2", "--set", "camera.fov=45"]
QUICK_TRACKER = ["--set", "tracker.segmentation_size=64"]

STOPPING_TRACKER = """
import os
import signal
from tracking3d.trackers.csrt import CsrtTracker

class Stopping(CsrtTracker):
    def step(self, frame):
        if frame.index == 2:
            # A shell's background job starts with Ctrl-C ignored; here it is to arrive.
            signal.signal(signal.SIGINT, signal.default_int_handler)
            os.kill(os.getpid(), getattr(signal, os.environ["STOP_BY"]))
        return super().step(frame)
"""


@pytest.fixture(scope="module")
def real_clip(tmp_path_factory) -> Path:
    return make_demo_clip(tmp_path_factory.mktemp("real") / "clip", frames=4, size=(96, 72))


@pytest.fixture
def box(real_clip: Path) -> str:
    return ",".join(str(value) for value in json.loads((real_clip / "init.json").read_text())["bbox_xywh"])


def test_real_run_from_a_box(real_clip, box, tmp_path):
    result = forked_program(
        tmp_path, "run", real_clip / "frames", "--box", box, *QUICK, *QUICK_TRACKER, "--out", tmp_path / "run"
    )
    assert result.returncode == 0, result.stderr
    run = RunReader(tmp_path / "run")
    assert run.state == "finished"
    assert [frame.index for frame in run.frames] == [0, 1, 2, 3]
    scores = CliRunner().invoke(app, ["evaluate", str(tmp_path / "run"), "--truth", str(real_clip), "--json"])
    assert json.loads(scores.stdout)["iou_initial_mean"] > 0.5


@pytest.mark.slow
def test_real_run_from_masks_alone(real_clip, tmp_path):
    masks = ("--masks", real_clip / "masks")
    result = forked_program(
        tmp_path, "run", real_clip / "frames", *masks, *QUICK, "--out", tmp_path / "run", "--quiet"
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    frames = RunReader(tmp_path / "run").frames
    assert len(frames) == 4
    assert all(frame.iou_initial is not None for frame in frames)


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize(("stop", "code"), [("SIGINT", 130), ("SIGTERM", 130), ("SIGKILL", -signal.SIGKILL)])
def test_stopped_run_keeps_every_finished_frame(real_clip, box, tmp_path, stop, code):
    (tmp_path / "stopping.py").write_text(STOPPING_TRACKER)
    result = forked_program(
        tmp_path,
        *("run", real_clip / "frames", "--box", box, *QUICK, *QUICK_TRACKER),
        *("--tracker", "stopping", "--out", tmp_path / "run"),
        TRACKING3D_PLUGINS=f"tracking3d.trackers:stopping={tmp_path / 'stopping.py'}:Stopping",
        STOP_BY=stop,
    )
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    run = RunReader(tmp_path / "run")
    killed = stop == "SIGKILL"
    assert run.state == "interrupted"
    assert run.state_in_words == "interrupted (its process is gone)" if killed else "interrupted"
    assert run.description["state"] == ("running" if killed else "interrupted")
    for made in ("mesh.glb", "contact_sheet.png"):
        assert (tmp_path / "run" / made).is_file() is not killed
    # A kill while frame 2 is asked for may meet frame 1 on its way to disk: it is there whole, or not at all.
    assert [frame.index for frame in run.frames] in ([[0], [0, 1]] if killed else [[0, 1]])
    assert all(run.mask(frame.index).any() for frame in run.frames)
