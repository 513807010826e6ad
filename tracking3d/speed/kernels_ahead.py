"""Compiling every kernel before it is needed: ``python -m tracking3d.speed.kernels_ahead``.

Otherwise each is compiled when it is called for the first time, by every process that comes to it meanwhile. An image
for many machines, or a test run with several workers, does it once.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import pkgutil
from pathlib import Path
from types import ModuleType

from tracking3d.rendering.kernels.compilation import Kernel


def kernel_modules() -> list[str]:
    """Full names of the modules that hold kernels: those in rooms' folders ``kernels``."""
    found = pkgutil.walk_packages([str(Path(__file__).parents[1])], "tracking3d.")
    return sorted(one.name for one in found if ".kernels." in one.name)


def compile_module(name: str) -> int:
    """Compile the kernels of a module, or load those that are kept on disk.

    Returns:
        How many it holds.
    """
    kernels = find_kernels(importlib.import_module(name))
    for kernel in kernels:
        kernel.compile()
    return len(kernels)


def find_kernels(module: ModuleType) -> list[Kernel]:
    """The kernels that a module defines."""
    return [
        one for one in vars(module).values() if isinstance(one, Kernel) and one.__module__ == module.__name__
    ]


def main() -> None:
    """Compile all, side by side."""
    with multiprocessing.get_context("spawn").Pool(min(os.cpu_count() or 1, 8)) as pool:
        count = sum(pool.imap_unordered(compile_module, kernel_modules()))
    print(f"{count} kernels are compiled.")


if __name__ == "__main__":
    main()
