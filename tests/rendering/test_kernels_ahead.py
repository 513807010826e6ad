"""All kernels can be compiled before they are needed, once and in the background."""

from __future__ import annotations

import importlib
import logging
import sys
from pathlib import Path

import pytest
from filelock import FileLock

import tracking3d
from tracking3d.rendering.kernels.compilation import _announced
from tracking3d.runtime.progress import StageProgress, listen_to_progress
from tracking3d.speed import kernels_ahead
from tracking3d.speed.kernels_ahead import (
    compile_in_background,
    compile_module,
    compile_with_progress,
    find_kernels,
    kernel_modules,
)

PACKAGE = Path(tracking3d.__path__[0])
SMALL = """
from tracking3d.rendering.kernels.compilation import kernel

@kernel("float64(float64)")
def twice(value):
    return 2 * value
"""


@pytest.fixture
def started(tmp_path, monkeypatch) -> list[list[str]]:
    """The only kernel is a small one that is not compiled yet; gives the processes that are started."""
    commands: list[list[str]] = []

    class Started:
        def __init__(self, command: list[str], **options: object) -> None:
            commands.append(command)

    (tmp_path / "only_kernel.py").write_text(SMALL)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "only_kernel", raising=False)
    monkeypatch.setattr(kernels_ahead, "kernel_modules", lambda: ["only_kernel"])
    monkeypatch.setattr(kernels_ahead.subprocess, "Popen", Started)
    _announced.clear()
    return commands


def test_every_kernel_of_every_room_is_found():
    marked = sum(path.read_text().count("\n@kernel(") for path in PACKAGE.rglob("kernels/*.py"))
    assert marked == sum(len(find_kernels(importlib.import_module(name))) for name in kernel_modules())
    assert marked == sum(path.read_text().count("\n@kernel(") for path in PACKAGE.rglob("*.py"))
    assert marked > 20


def test_compiling_a_module_compiles_its_kernels():
    name = "tracking3d.trackers.kernels.colour_models"
    assert compile_module(name) == len(find_kernels(importlib.import_module(name))) > 0
    assert all(one._compiled is not None for one in find_kernels(importlib.import_module(name)))


def test_compiling_missing_kernels_is_a_stage_with_a_count_beside_a_process_in_the_background(
    started, caplog
):
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append), caplog.at_level(logging.WARNING):
        compile_with_progress()
        assert importlib.import_module("only_kernel").twice._compiled is not None
        compile_with_progress()  # it is kept now
    assert heard == [StageProgress("compiling kernels", done, 1) for done in (0, 1)]
    assert (len(started), caplog.messages) == (1, [])


def test_missing_kernels_are_compiled_by_one_process_in_the_background(started, caplog):
    with caplog.at_level(logging.WARNING):
        assert compile_in_background()
        assert importlib.import_module("only_kernel").twice(1.5) == 3  # it is needed sooner
    assert (len(started), caplog.messages) == (1, [])


def test_kernels_that_are_kept_are_not_compiled_again(started, caplog):
    importlib.import_module("only_kernel").twice(1.5)
    with caplog.at_level(logging.WARNING):
        caplog.clear()
        assert not compile_in_background()
    assert (started, caplog.messages) == ([], [])


def test_nothing_is_started_or_said_while_another_process_compiles_them(started, tmp_path, caplog):
    module = importlib.import_module("only_kernel")
    with caplog.at_level(logging.WARNING), FileLock(module.twice.folder / "all_kernels.lock"):
        assert not compile_in_background()
        assert module.twice(1.5) == 3
    assert (started, caplog.messages) == ([], [])


def test_nothing_is_started_while_the_process_that_compiles_them_still_imports(started, caplog):
    assert compile_in_background()
    with caplog.at_level(logging.WARNING):
        caplog.clear()
        assert not compile_in_background()
    assert (len(started), caplog.messages) == (1, [])


def test_all_processes_ask_for_the_same_lock(monkeypatch):
    """Kernels lie in several folders, so that any of them might be the one that is missing."""
    assert (
        len({one.folder for name in kernel_modules() for one in find_kernels(importlib.import_module(name))})
        > 1
    )
    taken = []
    monkeypatch.setattr(
        kernels_ahead, "FileLock", lambda path, timeout: taken.append(path) or FileLock(path, timeout)
    )
    monkeypatch.setattr(kernels_ahead, "_compile_all", lambda modules, processes: 0)
    monkeypatch.setattr(kernels_ahead.os, "nice", lambda by: 0)
    monkeypatch.setattr(kernels_ahead.Kernel, "is_kept", False)
    monkeypatch.setattr(kernels_ahead, "_was_started", lambda mark: True)
    compile_in_background()
    kernels_ahead.main(in_background=True)
    assert len(taken) == 2
    assert len(set(taken)) == 1


def test_without_a_folder_to_keep_them_in_nothing_is_compiled_ahead(started, monkeypatch):
    monkeypatch.setattr(kernels_ahead.Kernel, "folder", None)
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        assert not compile_in_background()
        compile_with_progress()
    assert started == heard == []


def test_the_slowest_kernel_is_compiled_first():
    assert kernels_ahead._FIRST in kernel_modules()
