"""Fixtures shared by all tests."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
import torch

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


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Tests that run side by side on few cores wait for each other's threads far longer than they compute."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
