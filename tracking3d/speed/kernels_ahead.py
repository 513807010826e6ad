"""Compiling every kernel before it is needed: ``python -m tracking3d.speed.kernels_ahead``.

Otherwise each is compiled when it is called for the first time. An image for many machines, or a test run with several
workers, does it once; the command line does it in the background when it is first started.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import ModuleType

from filelock import FileLock, Timeout

from tracking3d.rendering.kernels.compilation import Kernel, announce_compilation
from tracking3d.runtime.progress import report_each

_FIRST = "tracking3d.estimation.online.optimization.kernels.pose_refinement"
"""Takes as long as ten others, and is needed soon."""
_MOST_PROCESSES = 8
_LOCK, _STARTED = "all_kernels.lock", "all_kernels.started"
_START = 60.0
"""Seconds that a started process may take until it has the lock."""


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


def _all_kernels() -> list[Kernel]:
    return [one for name in kernel_modules() for one in find_kernels(importlib.import_module(name))]


def compile_with_progress() -> None:
    """Compile the kernels that are not kept on disk, beside a process that does so in the background.

    It is a stage with a count. Nothing is compiled if they cannot be kept.
    """
    kernels = _all_kernels()
    missing = [one for one in reversed(kernels) if kernels[0].folder and not one.is_kept]
    if missing:
        compile_in_background()
        # From the other end; what has been compiled in the background meanwhile is loaded.
        for one in report_each(
            "compiling kernels", sorted(missing, key=lambda one: one.__module__ == _FIRST)
        ):
            one.compile()


def compile_in_background() -> bool:
    """Let a process of its own compile the kernels that are not kept on disk; it goes on when this one ends.

    Of kernels that this process needs sooner and compiles itself, nothing is said.

    Returns:
        Whether a process was started; not if all are kept, they cannot be kept, or another process is at it.
    """
    kernels = _all_kernels()
    folder = kernels[0].folder
    if folder is None or all(one.is_kept for one in kernels):
        return False
    announce_compilation("", quiet=True)
    try:
        with FileLock(folder / _LOCK, timeout=0):
            alone = not _was_started(folder / _STARTED)
            if alone:
                (folder / _STARTED).touch()  # the process that is started takes the lock when it has imported
    except (Timeout, OSError, NotImplementedError):
        alone = False
    if not alone:
        return False
    process = subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import main; main(in_background=True)"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,
    )
    process.returncode = 0  # nobody waits for it
    return True


def main(in_background: bool = False) -> None:
    """Compile all, several at a time.

    Args:
        in_background: Leave a processor to whoever started this, and do nothing if another process is at it.
    """
    modules = sorted(kernel_modules(), key=lambda name: name != _FIRST)
    if in_background:
        folder = find_kernels(importlib.import_module(kernel_modules()[0]))[0].folder
        with suppress(AttributeError, OSError):
            os.nice(10)
        with suppress(Timeout, OSError, NotImplementedError):
            if folder is not None:
                with FileLock(folder / _LOCK, timeout=0):
                    _compile_all(modules, max((os.cpu_count() or 1) - 1, 1))
        return
    print(f"{_compile_all(modules, os.cpu_count() or 1)} kernels are compiled.")


def _compile_all(modules: list[str], processes: int) -> int:
    with multiprocessing.get_context("spawn").Pool(min(processes, _MOST_PROCESSES)) as pool:
        return sum(pool.imap_unordered(compile_module, modules))


def _was_started(mark: Path) -> bool:
    """Whether a process that compiles all kernels was started a moment ago, and is still importing."""
    try:
        return time.time() - mark.stat().st_mtime < _START
    except OSError:
        return False


if __name__ == "__main__":
    main()
