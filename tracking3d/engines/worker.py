"""The environment of a task in any worker: output to the log, few threads, failures as data."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

from tracking3d.engines.protocol import Fault, Reporter, Task
from tracking3d.errors import Tracking3dError

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables from which libraries read their number of threads when they are imported."""

_DUMP = 100  # lines, at most, of what the fault handler writes


def threads_in_words(threads: int) -> dict[str, str]:
    """The environment that gives libraries so many threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(threads))


def call(task: Task, tell: Reporter, threads: int = 1) -> tuple[Any, Fault | None]:
    """Do a task in this process: what it returned, or why it failed.

    Raises:
        KeyboardInterrupt: If it was to stop.
    """
    with redirect_prints(task.log):
        try:
            _give_threads(threads)
            return task.function(tell, *task.arguments), None
        except (Exception, SystemExit) as error:
            with suppress(OSError):  # the disk may be full
                traceback.print_exc()
            return None, Fault(sentence_of(error))


def sentence_of(error: BaseException) -> str:
    """Why something failed, as one line."""
    if isinstance(error, Tracking3dError):
        return " ".join(error.at_the_command_line.split())
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def last_words(log: Path | None) -> str:
    """The last line of a log, and where the rest is; empty if there is none."""
    if log is None:
        return ""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        return ""
    # If Python's fault handler is on, it lists modules after the error.
    fatal = [line for line in lines[-_DUMP:] if line.startswith("Fatal Python error")]
    said = (fatal or lines[-1:] or ["it left no message"])[0]
    return f": {said.strip()}; see {log}"


def interruptible() -> None:
    """From here on SIGTERM lets the task save its finished frames, and Ctrl-C is left to the master process."""

    def stop(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, stop)


@contextmanager
def redirect_prints(log: Path | None) -> Iterator[None]:
    """What this process prints within is added to a file, by native code too."""
    if log is None:
        yield
        return
    log.parent.mkdir(parents=True, exist_ok=True)
    _flush()
    before = [os.dup(number) for number in (1, 2)]
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        for number in (1, 2):
            os.dup2(file, number)
        yield
    finally:
        _flush()
        for number, kept in zip((1, 2), before, strict=True):
            os.dup2(kept, number)
            os.close(kept)
        os.close(file)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, AttributeError):
            stream.flush()


def _give_threads(threads: int) -> None:
    """Limit OpenCV and torch, if they are imported, to their share of the machine."""
    if cv2 := sys.modules.get("cv2"):
        cv2.setNumThreads(threads)
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(threads)
