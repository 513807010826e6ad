"""Fixtures for the tests of the run folder."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from turning_sphere import TurningSphere, started_run, turning_sphere_of, written_run

from tracking3d.results.run_writer import RunWriter


@pytest.fixture(scope="session")
def turning_sphere() -> TurningSphere:
    """Eight frames of 160 x 120."""
    return turning_sphere_of(8)


@pytest.fixture(scope="session")
def make_turning_sphere() -> Callable[..., TurningSphere]:
    """Makes turning spheres of other lengths and sizes."""
    return turning_sphere_of


@pytest.fixture(scope="session")
def start_run() -> Callable[..., RunWriter]:
    """Starts a run: ``start_run(folder, clip, **changes)``."""
    return started_run


@pytest.fixture(scope="session")
def write_run() -> Callable[..., None]:
    """Writes a whole run: ``write_run(folder, clip, **changes)``."""
    return written_run
