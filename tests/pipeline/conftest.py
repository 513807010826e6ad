"""What tests of whole runs share: a small clip, its images, and a solver that answers at once."""

from __future__ import annotations

from pathlib import Path

import pytest
from refining_solver import CausalSolver, StandInSolver

from tracking3d.pipeline.session import SOLVERS
from tracking3d.results.files import write_image
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize


@pytest.fixture(scope="module")
def clip(request) -> SyntheticClip:
    """As many frames as the module of the tests says by ``FRAMES``."""
    frames = request.module.FRAMES
    return synthesize(SyntheticSpec(frames=frames, size=(80, 64), supersample=1, degrees_per_frame=4))


@pytest.fixture(scope="module")
def images(clip, tmp_path_factory) -> Path:
    """A folder with the images of the clip."""
    folder = tmp_path_factory.mktemp("clip")
    for index, image in enumerate(clip.images):
        write_image(folder / f"{index:03d}.png", image)
    return folder


@pytest.fixture
def stand_in_solver(monkeypatch) -> None:
    """The solver of runs is `StandInSolver`, and has no faults."""
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)
    monkeypatch.setattr(CausalSolver, "faults", {})
    monkeypatch.setattr(StandInSolver, "revisit_faults", {})
    monkeypatch.setattr(StandInSolver, "seen", [])
