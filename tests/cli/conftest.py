"""A clip on disk, a session that answers at once, and the program to call."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import trimesh
from PIL import Image
from typer.testing import CliRunner, Result

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.plugins import TRACKERS, build_plugin

HEIGHT, WIDTH, FRAMES = 48, 64, 5


@dataclass
class Script:
    """What the fake session is to raise in which frame, and what it was built with."""

    faults: dict[int, BaseException] = field(default_factory=dict)
    built: list[tuple] = field(default_factory=list)


@pytest.fixture(autouse=True)
def heard_again() -> Iterator[None]:
    """What ``--quiet`` silences in one command is heard in the next."""
    yield
    logging.getLogger("tracking3d").setLevel(logging.NOTSET)


@pytest.fixture(autouse=True)
def no_turntable(monkeypatch) -> None:
    """The movie takes longer than everything else that these runs write."""
    monkeypatch.setattr("tracking3d.ui.report.run_report.write_turntable", lambda *_: None)


@pytest.fixture
def script(monkeypatch) -> Script:
    """Replace the estimator by one that answers with the prompt's box at once."""
    script = Script()

    class FakeSession:
        renderer: ClassVar = {"backend": "none", "reason": "a test", "threads": 1}
        state_classes = ()
        corrected = replays = False

        def __init__(self, config, prompt, intrinsics=None, intrinsics_origin="", encoder=None, live=False):
            script.built.append((config, prompt))
            self.config = config
            self.can_refine, self.initial_mask = False, MaskEstimate(None)
            build_plugin(TRACKERS, config.tracker)

        def step(self, frame, prompt=None):
            if fault := script.faults.get(frame.index):
                raise fault
            self.camera = Camera.from_fov(frame.size[1], frame.size[0])
            mask = np.zeros(frame.size, dtype=bool)
            mask[10:30, 20:40] = True
            T = np.eye(4)
            T[2, 3] = 3
            return FrameEstimate(frame.index, frame.time, T, mask, mask, Status.TRACKED, "", 1.0, seconds=0.1)

        def state_dict(self):
            return {}

        def load_state_dict(self, first, kept, failures):
            self.camera = Camera.from_fov(first.size[1], first.size[0])

        def finish_background_work(self):
            return []

        def failure_at(self, index):
            return ""

        def result(self):
            sphere = trimesh.creation.icosphere(1)
            uvs = np.full((*sphere.faces.shape, 2), 0.5)
            texture = np.zeros((4, 4, 3))
            return ObjectModel(
                sphere.vertices, sphere.faces, uvs, texture.astype(np.uint8), texture[..., 0], texture
            )

    monkeypatch.setattr("tracking3d.pipeline.open_tracking.Session", FakeSession)
    return script


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """A folder of five images of noise."""
    folder = tmp_path / "clip"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(FRAMES):
        pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{index:03d}.png")
    return folder


@pytest.fixture
def mask_file(tmp_path: Path):
    """Write a mask image and return its path."""

    def write(mask: np.ndarray, name: str = "mask.png") -> Path:
        Image.fromarray((mask * 255).astype(np.uint8)).save(tmp_path / name)
        return tmp_path / name

    return write


@pytest.fixture
def call(tmp_path: Path, monkeypatch):
    """Call the program in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> Result:
        from tracking3d.cli import app

        return CliRunner().invoke(app, [str(argument) for argument in arguments])

    return call


@pytest.fixture
def refused(call):
    """Call the program with something it cannot use, and return the one line it prints."""

    def refused(*arguments: object) -> str:
        result = call(*arguments)
        assert result.exit_code == 2, result.output
        [line] = result.stderr.splitlines()
        assert line.startswith("error: ")
        assert result.stdout == ""
        return line

    return refused
