"""Processes that have imported everything when they start: a fork of one that did it once."""

from __future__ import annotations

import multiprocessing
import os
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

_IMPORTED = [
    "__main__",
    "cv2",
    "kornia",
    "onnxruntime",
    "torch",
    "tracking3d.cli.run",
    "tracking3d.estimation.online.solver",
    "tracking3d.pipeline.record",
    "tracking3d.rendering.kernels.compilation",
    "tracking3d.testing.synthesis.convex_clips",
    "tracking3d.trackers.csrt",
    "tracking3d.trackers.flow",
    "tracking3d.trackers.precomputed",
]


@dataclass(frozen=True)
class Ended:
    """What a process left behind; the names are those of `subprocess.CompletedProcess`."""

    returncode: int
    stdout: str
    stderr: str


def forked(function: Callable[..., None], *arguments: Any) -> BaseProcess:
    """A process, not yet started, that calls a function of some module with one thread."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_IMPORTED)
    return context.Process(target=_call, args=(function, arguments))


def forked_program(folder: Path, *arguments: object, **environment: str) -> Ended:
    """The command line in a process of its own; what it prints passes through files in ``folder``."""
    return _ended(folder, _program, list(map(str, arguments)), environment)


def forked_script(folder: Path, script: str, *arguments: object) -> Ended:
    """Lines of Python in a process of their own, as ``python -c`` would run them."""
    return _ended(folder, _script, script, list(map(str, arguments)))


def _ended(folder: Path, function: Callable[..., None], *arguments: Any) -> Ended:
    out, err = folder / "stdout", folder / "stderr"
    process = forked(_told, out, err, function, arguments)
    process.start()
    process.join()
    assert process.exitcode is not None
    return Ended(process.exitcode, out.read_text(), err.read_text())


def forked_in_terminal(terminal: str, *arguments: object) -> BaseProcess:
    """The command line in a process of its own, not yet started, whose terminal is the device ``terminal``."""
    return forked(_program_in_terminal, terminal, list(map(str, arguments)))


def _call(function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    function(*arguments)


def _told(out: Path, err: Path, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    """Call a function with what it prints in files."""
    for number, path in ((1, out), (2, err)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    try:
        function(*arguments)
    except Exception:
        traceback.print_exc()
        raise


def _program(arguments: list[str], environment: dict[str, str]) -> None:
    from tracking3d.cli import main

    os.environ.update(environment)
    sys.path[:0] = environment.get("PYTHONPATH", "").split(os.pathsep)
    sys.argv = ["tracking3d", *arguments]
    main()


def _program_in_terminal(terminal: str, arguments: list[str]) -> None:
    device = os.open(terminal, os.O_RDWR | os.O_NOCTTY)
    for number in range(3):
        os.dup2(device, number)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))  # noqa: SIM115
    _program(arguments, {"TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"})


def _script(script: str, arguments: list[str]) -> None:
    sys.argv = ["-c", *arguments]
    exec(script, {"__name__": "__main__"})
