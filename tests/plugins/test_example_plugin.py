"""The example package is installed as anyone would, and its tracker is found, listed and used."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from forked import forked_program

from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import make_demo_clip

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder into which pip has installed the package."""
    if any(importlib.util.find_spec(name) is None for name in ("pip", "setuptools")):
        pytest.skip("installing a package without the network needs pip and setuptools in this environment")
    folder = tmp_path_factory.mktemp("example")
    # Building leaves files beside the sources, so those of the checkout are left alone.
    leftovers = shutil.ignore_patterns("build", "*.egg-info", "__pycache__")
    source = shutil.copytree(ROOT / "plugins" / "tracking3d-kcf", folder / "source", ignore=leftovers)
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index"]
    options = ["--no-deps", "--no-build-isolation", "--target", str(folder / "site")]
    result = subprocess.run([*install, *options, str(source)], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return folder / "site"


@pytest.fixture
def program(installed: Path, tmp_path: Path):
    """Call the command line in a process that finds the installed package."""

    def program(*arguments: object) -> str:
        ended = forked_program(tmp_path, *arguments, PYTHONPATH=str(installed))
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    return program


def test_the_installed_plugin_is_listed(program):
    listed = {plugin["name"]: plugin for plugin in json.loads(program("plugins", "--json"))}
    kcf = listed["kcf"]
    assert (kcf["group"], kcf["package"], kcf["status"]) == ("tracking3d.trackers", "tracking3d-kcf", "ok")
    assert kcf["version"]
    assert "threshold" in kcf["options"]["properties"]
    assert {"csrt", "precomputed", "rgb"} <= set(listed)


def test_the_installed_plugin_tracks_a_clip(program, tmp_path):
    clip = make_demo_clip(tmp_path / "clip", frames=3, size=(96, 72))
    box = ",".join(str(value) for value in json.loads((clip / "init.json").read_text())["bbox_xywh"])
    quick = ["--size", "32", "--set", "object.frequency=2", "--set", "camera.fov=45"]
    option = ["--set", "tracker.threshold=0.4"]
    program(
        *("run", clip / "frames", "--box", box, "--tracker", "kcf", *option, *quick),
        *("--out", tmp_path / "run", "--quiet"),
    )
    run = RunReader(tmp_path / "run")
    assert run.state == "finished"
    assert run.description["config"]["tracker"] == {"name": "kcf", "threshold": 0.4}
    assert len(run.frames) == 3
    assert all(frame.iou_initial is not None for frame in run.frames)
