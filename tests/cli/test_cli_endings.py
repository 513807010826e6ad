"""However a command ends, it says why in a sentence: no place to print, nobody who reads, little memory."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

from tracking3d.cli import program
from tracking3d.results import layout
from tracking3d.results.run_reader import RunReader

PYTHON = [sys.executable, "-m", "tracking3d"]


def test_the_package_is_a_program():
    done = subprocess.run([*PYTHON, "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("tracking3d ")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
def test_a_full_device_is_told():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*PYTHON, "config", "schema"], stdout=full, stderr=-1, text=True, check=False)
    assert done.returncode == 2
    [line] = done.stderr.splitlines()
    assert line.startswith("error: the output cannot be written (No space left on device)")


def test_a_folder_that_was_deleted_is_told(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    script = f"rmdir {gone} && exec {sys.executable} -m tracking3d run {tmp_path} --box 1,2,3,4 --out {tmp_path}/run"
    path = {**os.environ, "PYTHONPATH": str(Path(program.__file__).parents[2])}
    done = subprocess.run(
        ["sh", "-c", script], cwd=gone, env=path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == "error: The current folder has been deleted; change to one that exists.\n"


def test_a_closed_pipe_ends_in_silence():
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*PYTHON, "config", "schema"], stdout=writer, stderr=-1, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (program.UNREAD, b"")


@pytest.mark.slow
def test_letters_that_a_terminal_has_not_are_no_fault(tmp_path):
    file = tmp_path / "ünïcode.yaml"
    file.write_text("preset: default")
    plain = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    for name, code in ((file, 0), (file.with_name("äbsent.yaml"), 2)):
        done = subprocess.run(
            [*PYTHON, "config", "validate", name],
            env={**os.environ, **plain},
            capture_output=True,
            check=False,
        )
        assert done.returncode == code
        assert b"Traceback" not in done.stderr


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError(
            "[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes."
        ),
        RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        RuntimeError("can't start new thread"),
        OSError(12, "Cannot allocate memory"),
    ],
    ids=repr,
)
def test_little_memory_is_told_with_what_to_lower(call, clip, script, error):
    script.faults[2] = error
    result = call("run", clip, "--box", "20,10,20,20", "--out", "run")
    assert result.exit_code == 2
    first, kept, advice = result.stderr.splitlines()[-3:]
    assert first.startswith("error: there is not enough memory; lower --size (window.size)")
    assert kept == "The frames finished until then are in run."
    assert advice.startswith("To continue from there: tracking3d ") and advice.endswith(" --resume")
    assert len(Path("run/frames.jsonl").read_text().splitlines()) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit address space")
def test_little_address_space_is_refused_before_a_library_that_is_loaded_ends_the_process(clip):
    limited = f"ulimit -v 1800000 && exec {shlex.join([*PYTHON, 'run', str(clip), '--box', '20,10,20,20'])}"
    done = subprocess.run(["bash", "-c", limited], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == (
        "error: The process may use 1.8 GB of address space (ulimit -v), which is not enough memory; "
        "allow 2.5 GB or more.\n"
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", [0, 1, 2])
def test_a_signal_while_the_mesh_is_written_ends_the_run_and_resume_finishes_it(
    call, clip, script, monkeypatch, number, moment
):
    """trimesh, which writes vertices, normals and texture coordinates by this function, catches `BaseException`."""
    calls, function = [], trimesh.util.array_to_string

    def signalling(*given, **named):
        calls.append(0)
        if len(calls) == moment + 1:
            signal.raise_signal(number)
        return function(*given, **named)

    monkeypatch.setattr(trimesh.util, "array_to_string", signalling)
    command = ("run", clip, "--box", "20,10,20,20", "--out", "run")
    result = call(*command)
    assert result.exit_code == program.INTERRUPTED
    assert "interrupted" in result.stderr.splitlines()
    assert RunReader(Path("run")).state == "interrupted"
    assert call(*command, "--resume").exit_code == 0
    assert RunReader(Path("run")).state == "finished"
    assert not {*layout.MESH_FILES, layout.OVERLAY, layout.CONTACT_SHEET, layout.REPORT} - {
        path.name for path in Path("run").iterdir()
    }


@pytest.mark.parametrize(
    ("options", "name"),
    [(["--out", ""], "--out"), (["--preset="], "--preset"), (["--intrinsics", ""], "--intrinsics")],
)
def test_an_empty_option_is_refused_by_its_name(refused, clip, options, name):
    assert f"{name} is empty; give it a value or leave it out." in refused("run", clip, *options)


def test_an_empty_source_is_refused(refused):
    assert "an argument is empty" in refused("run", "")


@pytest.mark.parametrize("name", ["list", "path"])
def test_ready_configurations_are_named_and_found(call, refused, name):
    if name == "list":
        assert "flat-object: A card, a book cover" in call("config", "list").stdout
    else:
        assert Path(call("config", "path", "flat-object").stdout.strip()).is_file()
        assert "did you mean 'flat-object'?" in refused("config", "path", "flat-objct")
