"""All kernels can be compiled before they are needed, once and in the background."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import tracking3d
from tracking3d.cli.progress import load_with_progress
from tracking3d.runtime import kernels_ahead
from tracking3d.runtime.kernels_ahead import compile_missing, compile_module, find_kernels, kernel_modules
from tracking3d.runtime.progress import StageProgress, listen_to_progress

PACKAGE = Path(tracking3d.__path__[0])
SMALL = """
from tracking3d.rendering.kernels.compilation import kernel

@kernel("float64(float64)")
def twice(value):
    return 2 * value
"""


class Pool:
    """Compiles in this process."""

    def __init__(self, processes: int, initializer: object) -> None:
        pass

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    imap_unordered = staticmethod(map)


@pytest.fixture
def only_kernel(tmp_path, monkeypatch) -> ModuleType:
    """The only kernel is a small one that is not compiled yet."""
    (tmp_path / "only_kernel.py").write_text(SMALL)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "only_kernel", raising=False)
    monkeypatch.setattr(kernels_ahead, "kernel_modules", lambda: ["only_kernel"])
    monkeypatch.setattr(
        kernels_ahead.multiprocessing, "get_context", lambda method: SimpleNamespace(Pool=Pool)
    )
    return importlib.import_module("only_kernel")


def test_every_kernel_of_every_room_is_found():
    marked = sum(path.read_text().count("\n@kernel(") for path in PACKAGE.rglob("kernels/*.py"))
    assert marked == sum(len(find_kernels(importlib.import_module(name))) for name in kernel_modules())
    assert marked == sum(path.read_text().count("\n@kernel(") for path in PACKAGE.rglob("*.py"))
    assert marked > 20


def test_compiling_a_module_compiles_its_kernels():
    name = "tracking3d.trackers.kernels.colour_models"
    assert compile_module(name) == len(find_kernels(importlib.import_module(name))) > 0
    assert all(one._compiled is not None for one in find_kernels(importlib.import_module(name)))


def test_compiling_missing_kernels_is_a_stage_with_a_count(only_kernel):
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        assert compile_missing() == 1
        assert only_kernel.twice._compiled is not None and only_kernel.twice(1.5) == 3
        assert compile_missing() == 0  # it is kept now
    assert heard == [StageProgress("compiling kernels", done, 1) for done in (0, 1)]


def test_without_a_folder_to_keep_them_in_nothing_is_compiled_ahead(only_kernel, monkeypatch):
    monkeypatch.setattr(kernels_ahead.Kernel, "folder", None)
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        assert compile_missing() == 0
    assert heard == []


@pytest.mark.parametrize("command", ["run", "demo"])
def test_commands_compile_before_they_track_so_that_no_frame_takes_longer(monkeypatch, command):
    """The seconds of a frame that a run and the demo tell have no compilation in them."""
    compiled: list[bool] = []
    monkeypatch.setattr(kernels_ahead, "compile_missing", lambda: compiled.append(True))
    load_with_progress("tracking3d.pipeline.record", quiet=True, kernels=True)
    assert compiled == [True]
    source = inspect.getsource(importlib.import_module(f"tracking3d.cli.{command}"))
    assert re.search(
        r'load_with_progress\("tracking3d.pipeline.record", quiet, kernels=(True|not asks)\)', source
    )


def test_the_slowest_kernel_is_compiled_first():
    assert kernels_ahead._FIRST in kernel_modules()
