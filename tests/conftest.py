"""Fixtures shared by all tests.

What takes long to import is imported where it is used: with workers, the process that hands out tests needs none of it.
"""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer.testing
from filelock import FileLock

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


def pytest_sessionstart(session: pytest.Session) -> None:
    """Tests that run side by side on few cores wait for each other's threads far longer than they compute."""
    if session.config.getoption("dist", "no") != "no":
        return  # the workers compute, and each of them comes here
    import cv2
    import torch
    from made_once import make_once

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    # Building the command line from its annotations takes longer than most commands; a command keeps no state.
    typer.testing._get_command = functools.cache(typer.testing._get_command)
    make_once()
    # Around every test pytest listens to every logger that keeps its messages to itself; torch has forty.
    for logger in logging.root.manager.loggerDict.values():
        if isinstance(logger, logging.Logger) and logger.name.startswith("torch"):
            logger.propagate = True


@pytest.fixture
def made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of whether something is the same when it is made again."""
    from made_once import MadeOnce

    monkeypatch.setattr(MadeOnce, "anew", True)


@pytest.fixture(scope="session", autouse=True)
def drawn_quickly() -> None:
    """See `quick_pictures`; it begins after the collection, where tests take sizes from modules."""
    from quick_pictures import draw_quickly

    draw_quickly()


@pytest.fixture
def as_users_see_it(drawn_quickly: None) -> Iterator[None]:
    """For tests that look at pictures of runs."""
    from quick_pictures import draw_as_users_see_it

    with draw_as_users_see_it():
        yield


@pytest.fixture(scope="session", autouse=True)
def made_together(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What one worker has made is there for the others; in a fresh clone that holds for compiled kernels, too."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    from made_once import MadeOnce

    from tracking3d.rendering.kernels.compilation import Kernel

    folder, compile_one = tmp_path_factory.getbasetemp().parent, Kernel._compile
    MadeOnce.folder = folder / "made"
    MadeOnce.folder.mkdir(exist_ok=True)

    def compile_once(kernel: Kernel):
        with FileLock(folder / f"{kernel.__module__}.{kernel.__qualname__}.lock"):
            return compile_one(kernel)

    Kernel._compile = compile_once
