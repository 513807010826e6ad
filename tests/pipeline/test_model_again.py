"""``tracking3d model`` makes the model of a finished run again as ``tracking3d run`` made it."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.results.run_reader import RunReader

FRAMES = 16
MESH = ("mesh.obj", "mesh.glb", "texture.png", "features.npz")


def made(*words: str | Path) -> None:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output


def files_of(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in MESH}


@pytest.fixture(scope="module")
def tracked(images, clip, tmp_path_factory) -> Path:
    """A run of the clip by default, and one of fewer frames, in which the object turns too little for a new shape."""
    folder = tmp_path_factory.mktemp("runs")
    box = ",".join(map(str, clip.box))
    for name, frames in (("turned", ":"), ("hardly_turned", ":4")):
        made(
            "run", images, "--box", box, "--frames", frames, "--no-report", "--quiet", "--out", folder / name
        )
    return folder


@pytest.mark.parametrize(("name", "again"), [("turned", True), ("hardly_turned", False)])
def test_a_finished_run_gets_the_same_mesh_again(tracked, name, again):
    run = tracked / name
    assert ("shape" in RunReader(run).description) is again
    before = files_of(run)
    made("model", run, "--quiet")
    assert files_of(run) == before
