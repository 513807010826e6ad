"""What workers are asked to do in the tests of engines: functions of a module, as they are pickled by name."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any


def square(tell: Any, number: int) -> int:
    tell(f"squaring {number}")
    os.write(1, f"squared {number}\n".encode())
    return number**2


def fail(tell: Any, sentence: str) -> None:
    from tracking3d.errors import InputError

    raise InputError(sentence)


def leave(tell: Any) -> None:
    sys.exit(3)


def abort(tell: Any) -> None:
    print("the last words", flush=True)
    os.abort()


def killed_once(tell: Any, note: Path) -> str:
    """Its process is killed the first time."""
    if not note.exists():
        note.write_text("was here")
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def told_to_stop(tell: Any, note: Path) -> None:
    """Goes on for ever, and notes that it was asked to stop."""
    try:
        tell("begun")
        while True:
            time.sleep(0.05)  # Ray interrupts between two lines of Python
    except KeyboardInterrupt:
        note.write_text("stopped")
        raise


def variable(tell: Any, name: str) -> str | None:
    return os.environ.get(name)


def surroundings(tell: Any, *names: str) -> tuple[Any, ...]:
    import cv2
    import torch

    found = [os.environ.get(name) for name in names]
    return (*found, torch.get_num_threads(), cv2.getNumThreads(), Path.cwd().name)


def node(tell: Any, seconds: float) -> str:
    """On which node of Ray it is; takes its time."""
    import ray

    name = ray.get_runtime_context().get_node_id()
    tell(name)
    time.sleep(seconds)
    return name
