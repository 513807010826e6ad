"""How a run ended can always be said, and is seen where nobody could say it."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tracking3d.errors import OutputError
from tracking3d.frames import SkippedFrame
from tracking3d.results import files, layout
from tracking3d.results.description import is_gone, this_process
from tracking3d.results.files import write_reserved
from tracking3d.results.run_reader import RunReader


@pytest.fixture
def full_disk(monkeypatch):
    """No new file has room; what is there may be written over."""

    def fill() -> None:
        def no_space(*_):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(Path, "write_bytes", no_space)

    return fill


@pytest.mark.parametrize("skipped", [0, 500], ids=["short", "grown beyond its reserve"])
def test_a_full_disk_leaves_a_state_that_says_so(tmp_path, turning_sphere, start_run, full_disk, skipped):
    writer = start_run(tmp_path, turning_sphere)
    writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
    full_disk()
    with pytest.raises(OutputError, match="The disk is full") as error:
        writer.write(turning_sphere.estimates[1], turning_sphere.frames[1])
    writer._description["skipped"] = [
        {"index": n, "reason": SkippedFrame(n, "gone").reason} for n in range(skipped)
    ]
    with pytest.raises(OutputError, match="The disk is full"):
        writer.finish(turning_sphere.model, "failed", str(error.value))
    run = RunReader(tmp_path)
    assert run.state == json.loads((tmp_path / layout.RUN).read_bytes())["state"] == "failed"
    assert "The disk is full" in run.description["error"]
    assert [frame.index for frame in run.frames] == [0]


def test_what_has_no_room_leaves_the_file_as_it_was(tmp_path, full_disk):
    path = tmp_path / "run.json"
    write_reserved(path, b"{}\n", 100)
    size = path.stat().st_size
    assert path.read_bytes().strip() == b"{}"
    full_disk()
    write_reserved(path, b'{"a": 1}\n', 100)
    assert (path.read_bytes().strip(), path.stat().st_size) == (b'{"a": 1}', size)
    with pytest.raises(OutputError, match="full"):
        write_reserved(path, b'"' + b"a" * size + b'"\n', 100)
    assert path.read_bytes().strip() == b'{"a": 1}'


def ended_process() -> dict:
    """What a process told of itself that is gone."""
    script = "import json; from tracking3d.results.description import this_process; print(json.dumps(this_process()))"
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    told: dict = json.loads(done.stdout)
    return told


def test_a_process_is_known_by_number_machine_and_start():
    here = this_process()
    assert is_gone(here) is False
    assert is_gone(ended_process()) is True
    assert is_gone({**here, "host": "elsewhere"}) is None
    assert is_gone({}) is None
    assert is_gone({**here, "started": here["started"] - 60}) is True, "a later process has its number"


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX processes")
@pytest.mark.parametrize("locks", [True, False], ids=["with locks", "on a file system without locks"])
def test_a_run_whose_process_is_gone_is_seen(tmp_path, turning_sphere, start_run, monkeypatch, locks):
    writer = start_run(tmp_path, turning_sphere)
    writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
    if not locks:

        def none(*_):
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

        monkeypatch.setattr(files, "_lock", none)
    assert RunReader(tmp_path).state_in_words == "running"
    assert "is running; frames estimated so far: 1" in RunReader(tmp_path).not_finished
    writer._lines.close()
    writer._pictures.close()
    path = tmp_path / layout.RUN
    description = json.loads(path.read_bytes())
    assert description["process"] == this_process()
    path.write_text(json.dumps({**description, "process": ended_process()}))
    run = RunReader(tmp_path)
    assert (run.state, run.state_in_words) == ("interrupted", "interrupted (its process is gone)")
    assert "interrupted (its process is gone); frames" in run.not_finished
