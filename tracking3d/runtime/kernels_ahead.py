"""Compiling every kernel before it is needed: ``python -m tracking3d.runtime.kernels_ahead``.

Otherwise each is compiled when it is called for the first time. An image for many machines, or a test run with several
workers, does it once; the command line does it when it is first started.
"""

from __future__ import annotations

import importlib
import logging
import multiprocessing
import os
import signal
from pathlib import Path
from types import ModuleType

from tracking3d.rendering.kernels.compilation import Kernel
from tracking3d.runtime.progress import report_each

_FIRST = "tracking3d.estimation.online.optimization.kernels.pose_refinement"
"""Takes as long as ten others."""
_MOST_PROCESSES = 8


def kernel_modules() -> list[str]:
    """Full names of the modules that hold kernels: those in rooms' folders ``kernels``."""
    package = Path(__file__).parents[1]
    found = (path.relative_to(package).with_suffix("").parts for path in package.rglob("kernels/[!_]*.py"))
    return sorted(".".join(["tracking3d", *parts]) for parts in found)


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


def compile_missing() -> int:
    """Compile the kernels that are not kept on disk, several at a time: a stage that counts their modules.

    None is compiled if they cannot be kept.

    Returns:
        How many kernels the modules hold that were compiled.
    """
    modules = {name: find_kernels(importlib.import_module(name)) for name in kernel_modules()}
    missing = [
        name
        for name in sorted(modules, key=lambda name: name != _FIRST)
        if any(one.folder is not None and not one.is_kept for one in modules[name])
    ]
    if not missing:
        return 0
    processes = min(os.cpu_count() or 1, _MOST_PROCESSES, len(missing))
    with multiprocessing.get_context("spawn").Pool(processes, _start_quietly) as pool:
        compiled = pool.imap_unordered(compile_module, missing)
        return sum(report_each("compiling kernels", compiled, len(missing)))


def _start_quietly() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that waits ends this one
    logging.disable()  # the stage says that kernels are compiled


if __name__ == "__main__":
    print(f"{compile_missing()} kernels are compiled.")
