"""All kernels can be compiled before they are needed."""

from __future__ import annotations

import importlib
from pathlib import Path

import tracking3d
from tracking3d.speed.kernels_ahead import compile_module, find_kernels, kernel_modules

PACKAGE = Path(tracking3d.__path__[0])


def test_every_kernel_of_every_room_is_found():
    marked = sum(path.read_text().count("\n@kernel(") for path in PACKAGE.rglob("kernels/*.py"))
    assert marked == sum(len(find_kernels(importlib.import_module(name))) for name in kernel_modules())
    assert marked == sum(path.read_text().count("\n@kernel(") for path in PACKAGE.rglob("*.py"))
    assert marked > 20


def test_compiling_a_module_compiles_its_kernels():
    name = "tracking3d.trackers.kernels.colour_models"
    assert compile_module(name) == len(find_kernels(importlib.import_module(name))) > 0
    assert all(one._compiled is not None for one in find_kernels(importlib.import_module(name)))
