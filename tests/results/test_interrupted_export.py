"""Ctrl-C and SIGTERM while a mesh is exported are heard, though trimesh catches `BaseException`."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import trimesh
from recorded_runs import model

from tracking3d.errors import OutputError
from tracking3d.results import layout
from tracking3d.results.files import write_together
from tracking3d.results.mesh_export import export_mesh, load_mesh, load_model, obj_files
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.interruption import interrupts_deferred


class Terminated(BaseException):
    """What the handler of SIGTERM raises here."""


@pytest.fixture
def sigterm_raises():
    def stop(number, frame):
        raise Terminated

    before = signal.signal(signal.SIGTERM, stop)
    yield
    signal.signal(signal.SIGTERM, before)


def signal_at_call(monkeypatch, owner, name: str, call: int, number: int) -> list[int]:
    """Send this process a signal as the ``call``-th call of a function begins; gives the calls that were made."""
    function, calls = getattr(owner, name), []

    def signalling(*given, **named):
        calls.append(len(calls))
        if calls[-1] == call:
            signal.raise_signal(number)
        return function(*given, **named)

    monkeypatch.setattr(owner, name, signalling)
    return calls


MOMENTS = {
    "vertices": (trimesh.util, "array_to_string", 0),
    "normals": (trimesh.util, "array_to_string", 1),
    "texture coordinates": (trimesh.util, "array_to_string", 2),
    "material": (trimesh.visual.material.SimpleMaterial, "to_obj", 0),
    "material of the glb": (trimesh.visual.material.PBRMaterial, "__hash__", 0),
}


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_signal_while_a_mesh_is_exported_is_heard(
    tmp_path, monkeypatch, sigterm_raises, moment, number, error
):
    calls = signal_at_call(monkeypatch, *MOMENTS[moment], number)
    with pytest.raises(error):
        export_mesh(tmp_path, model())
    assert calls
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("call", range(len(layout.MESH_FILES)))
def test_a_signal_between_two_files_leaves_all_of_them(tmp_path, monkeypatch, call):
    signal_at_call(monkeypatch, Path, "replace", call, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        export_mesh(tmp_path, model())
    assert {path.name for path in tmp_path.iterdir()} == set(layout.MESH_FILES)
    assert len(load_model(tmp_path).faces) == len(load_mesh(tmp_path).faces)


def test_files_that_belong_together_are_replaced_together_or_not_at_all(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    write_together({first: b"1", second: b"2"})
    with pytest.raises(OutputError):
        write_together({first: b"3", tmp_path / "absent" / "second": b"4"})
    assert (first.read_bytes(), second.read_bytes()) == (b"1", b"2")
    assert {path.name for path in tmp_path.iterdir()} == {"first", "second"}


def test_what_is_deferred_comes_once_and_the_handlers_are_as_before(sigterm_raises):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    reached = False
    with pytest.raises(Terminated), interrupts_deferred():
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
        reached = True
    assert reached
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


@pytest.mark.parametrize("absent", [layout.TEXTURE, layout.MTL])
def test_a_run_whose_mesh_is_not_whole_is_not_finished(
    tmp_path, monkeypatch, turning_sphere, start_run, absent
):
    """As it was when the library caught an error and left out the material."""

    def without(*given):
        return {name: data for name, data in obj_files(*given).items() if name != absent}

    monkeypatch.setattr("tracking3d.results.mesh_export.obj_files", without)
    writer = start_run(tmp_path, turning_sphere)
    writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
    with pytest.raises(OutputError, match=f"{absent} is missing"):
        writer.finish(turning_sphere.model, "finished")
    run = RunReader(tmp_path)
    assert run.state == "failed" and absent in run.description["error"]


def test_a_run_that_is_interrupted_while_it_ends_says_so(tmp_path, monkeypatch, turning_sphere, start_run):
    writer = start_run(tmp_path, turning_sphere)
    writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
    signal_at_call(monkeypatch, trimesh.util, "array_to_string", 1, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        writer.finish(turning_sphere.model, "finished")
    assert RunReader(tmp_path).description["state"] == "interrupted"
