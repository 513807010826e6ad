"""A run with doubts, and without the network what the viewer shows of it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # recorded_runs, raw_requests, browser

from recorded_runs import write_run

from tracking3d.estimation.estimate import Status

DOUBTS = {
    3: (Status.UNCERTAIN, "points agree, pixels do not (loss 0.35)"),
    4: (Status.UNCERTAIN, "points agree, pixels do not (loss 0.41)"),
    5: (Status.LOST, "<b onclick='alert(1)'>too few</b> points"),
    8: (Status.LOST, ""),
}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run of twelve frames."""
    return write_run(tmp_path / "run", 12, DOUBTS)
