"""A cluster that does not respond is given some seconds, and then a sentence; Ray is a stand-in here."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tracking3d.engines import on_ray
from tracking3d.engines.choosing import open_engine
from tracking3d.errors import InputError

RAY = """
import os, sys, time
from pathlib import Path

here = Path(__file__).parent
begun = False

def is_initialized():
    return begun

def shutdown():
    pass

def init(address=None, **more):
    global begun
    print("a line of Ray's log", file=sys.stderr, flush=True)
    with (here / "processes").open("a") as file:
        print(os.getpid(), address, file=file)
    if address == "10.0.0.1:1":
        time.sleep(600)
    if address == "10.0.0.2:1":
        os.kill(os.getpid(), 9)
    if address == "10.0.0.3:1":
        raise ConnectionError("Could not find any running\\nRay instance.")
    begun = True
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A module ray, for this process and for others; gives the file of the processes that connected."""
    (tmp_path / "ray.py").write_text(RAY)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    on_ray._ray.cache_clear()
    monkeypatch.setattr(on_ray, "RayEngine", lambda workers, needs: "the engine")
    yield tmp_path / "processes"
    on_ray._ray.cache_clear()
    sys.modules.pop("ray", None)


def processes(file: Path) -> list[int]:
    return [int(line.split()[0]) for line in file.read_text().splitlines()]


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("10.0.0.1:1", "no response in 0.5 seconds"),
        ("10.0.0.2:1", "Ray ended while it connected"),
        ("10.0.0.3:1", "Could not find any running Ray instance"),
    ],
)
def test_a_cluster_that_does_not_respond_is_told_in_a_sentence(stand_in, monkeypatch, capfd, address, words):
    monkeypatch.setattr(on_ray, "RESPONSE", 0.5)
    with pytest.raises(InputError) as error, open_engine(address, 2):
        pass
    assert f"No Ray cluster responds at --address {address} ({words}); give auto" in str(error.value)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")
    [process] = processes(stand_in)
    assert process != os.getpid()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_a_cluster_that_responds_is_connected_to(stand_in, capfd):
    with open_engine("10.0.0.4:1", 2) as engine:
        assert engine == "the engine"
    assert len(processes(stand_in)) == 2 and processes(stand_in)[1] == os.getpid()


def test_this_machine_is_not_tried_first(stand_in):
    with open_engine("local", 2):
        pass
    assert processes(stand_in) == [os.getpid()]
