"""What the run folder refuses, and what errors of the system cost."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from forked import forked_script

from tracking3d.errors import OutputError
from tracking3d.results import layout
from tracking3d.results.run_reader import RunReader


def test_a_folder_in_use_is_refused_and_left_alone(tmp_path, turning_sphere, start_run):
    with start_run(tmp_path, turning_sphere) as writer:
        writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
        for overwrite in (False, True):
            with pytest.raises(OutputError, match="in use by another run"):
                start_run(tmp_path, turning_sphere, overwrite=overwrite)
        writer.write(turning_sphere.estimates[1], turning_sphere.frames[1])
    assert len(RunReader(tmp_path).frames) == 2


def test_an_earlier_run_is_replaced_only_when_asked(tmp_path, turning_sphere, start_run, write_run):
    write_run(tmp_path, turning_sphere)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "masks" / "mine.png").write_bytes(b"mine")
    (tmp_path / "masks" / ".000008.png.part").write_bytes(b"left by a kill")
    before = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()}
    with pytest.raises(OutputError, match="choose another folder or pass overwrite=True"):
        start_run(tmp_path, turning_sphere)
    assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()} == before
    start_run(tmp_path, turning_sphere, overwrite=True).finish(None, "interrupted")
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert left == ["frames.jsonl", "masks/mine.png", "notes.txt", "run.json"]
    assert RunReader(tmp_path).frames == []


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["masks/000000.png", "mesh.obj", "frames.jsonl", "run.json"])
def test_files_that_are_not_a_runs_are_never_touched(tmp_path, turning_sphere, name, overwrite, start_run):
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    with pytest.raises(OutputError, match=r"not a readable run folder, but holds .*; choose another folder"):
        start_run(tmp_path, turning_sphere, overwrite=overwrite)
    assert mine.read_text() == "mine"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [mine]


def test_a_file_in_place_of_the_folder_is_refused(tmp_path, turning_sphere, start_run):
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(OutputError, match="not a folder or lies inside a file"):
            start_run(folder, turning_sphere)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_write_permission_is_refused(tmp_path, turning_sphere, start_run):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="not writable; choose another folder"):
        start_run(tmp_path / "run", turning_sphere)
    tmp_path.chmod(0o700)


def failing(number: int) -> Any:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(number, os.strerror(number))

    return fail


@pytest.mark.parametrize(
    ("number", "message"),
    [(errno.EACCES, "not writable"), (errno.EROFS, "not writable"), (errno.EIO, "Input/output error")],
)
def test_the_systems_refusal_becomes_one_sentence(
    tmp_path, turning_sphere, monkeypatch, number, message, start_run
):
    monkeypatch.setattr(Path, "mkdir", failing(number))
    with pytest.raises(OutputError, match=message) as error:
        start_run(tmp_path / "run", turning_sphere)
    assert "\n" not in str(error.value)


FULL = """
import resource, sys
sys.path.insert(0, sys.argv[2])
from dataclasses import replace
from pathlib import Path
from turning_sphere import turning_sphere_of
from tracking3d.errors import OutputError
from tracking3d.results.description import RunHeader
from tracking3d.results.run_writer import RunWriter

clip = turning_sphere_of(6)
about = {"config": {}, "camera": clip.camera, "source": "clip", "seed": 0, "fps": None, "command": None}
writer = RunWriter(Path(sys.argv[1]), RunHeader(**about))
for frame, estimate in zip(clip.frames[:3], clip.estimates[:3]):
    writer.write(estimate, frame)
# No file may grow beyond this: within the fourth line.
size = (Path(sys.argv[1]) / "frames.jsonl").stat().st_size + 100
resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
try:
    writer.write(clip.estimates[3], clip.frames[3])
except OutputError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
writer.write(clip.estimates[4], clip.frames[4])
writer.finish(None, "failed", "the disk was full")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of file size are POSIX")
def test_a_full_disk_is_said_and_costs_the_current_frame_only(tmp_path):
    folder = tmp_path / "run"
    done = forked_script(tmp_path, FULL, folder, Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr
    assert "The disk is full" in done.stdout
    run = RunReader(folder)
    # No half line is left behind for the next one to be appended to.
    assert [record.index for record in run.frames] == [0, 1, 2, 4]
    assert run.state == "failed"


def test_what_fails_at_the_end_does_not_lose_the_rest(tmp_path, turning_sphere, monkeypatch, start_run):
    writer = start_run(tmp_path, turning_sphere)
    writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
    monkeypatch.setattr("trimesh.exchange.gltf.export_glb", failing(errno.ENOSPC))
    with pytest.raises(OSError, match="No space"):
        writer.finish(turning_sphere.model, "finished")
    run = RunReader(tmp_path)
    assert run.state == "failed"
    assert "No space" in run.description["error"]
    assert run.description["counts"]["frames"] == 1
    assert (tmp_path / layout.CONTACT_SHEET).is_file()
    assert (tmp_path / layout.OBJ).is_file()
