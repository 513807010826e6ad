"""Fixtures shared by all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def _shared(folder: str) -> Path:
    path = SHARED / folder
    if not path.is_dir():
        pytest.skip(f"the development {folder} beside the checkout (shared/{folder}) are absent")
    return path


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real clips with ground truth; the test is skipped where it is absent."""
    return _shared("data")


@pytest.fixture(scope="session")
def shared_models() -> Path:
    """Folder of real ONNX networks; the test is skipped where it is absent."""
    return _shared("models")
