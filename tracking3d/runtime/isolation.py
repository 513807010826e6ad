"""A session's threads and random numbers: in force while it works, and the caller's own in between.

The process has one set of random generators for all its threads. A session that works in another thread than the main
one leaves them alone, for other code would draw from them at the same time; what draws from them there, which only
plug-ins do, is not repeatable.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from tracking3d.rendering.backend import give_threads, threads_kept


@dataclass(frozen=True, eq=False)
class RandomState:
    """The states of the process's random generators: Python's, numpy's, torch's, and that of a CUDA device."""

    of_python: tuple[Any, ...]
    of_numpy: Any
    of_torch: Tensor
    of_cuda: Tensor | None

    @classmethod
    def now(cls, device: torch.device) -> RandomState:
        """What they are now."""
        cuda = torch.cuda.get_rng_state(device) if device.type == "cuda" else None
        return cls(random.getstate(), np.random.get_state(), torch.get_rng_state(), cuda)

    def same(self, other: RandomState) -> bool:
        """Whether the next random numbers are the same."""
        return (
            self.of_python == other.of_python
            and self.of_numpy[2:] == other.of_numpy[2:]
            and np.array_equal(self.of_numpy[1], other.of_numpy[1])
            and torch.equal(self.of_torch, other.of_torch)
            and _same(self.of_cuda, other.of_cuda)
        )

    def put(self, device: torch.device) -> None:
        """Make them so again."""
        random.setstate(self.of_python)
        np.random.set_state(self.of_numpy)
        torch.set_rng_state(self.of_torch)
        if self.of_cuda is not None:
            torch.cuda.set_rng_state(self.of_cuda, device)


class IsolatedRuntime:
    """Threads and random numbers of one session.

    The pipeline itself draws from generators of its own; the process's are seeded for plug-ins. Between the
    session's calls everything is the caller's, whose own random numbers do not change a session's estimates.

    Args:
        renderer: What renders, see `tracking3d.rendering.prepare_backend`.
        device: The device that is computed on.
        seed: Seed of everything random.

    Attributes:
        random: State of its random generators; None before the first use. The same object as long as none is drawn.
    """

    def __init__(self, renderer: Mapping[str, str | int], device: str, seed: int) -> None:
        self._renderer, self._device, self._seed = renderer, torch.device(device), seed
        self.random: RandomState | None = None

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """The session's settings within, the caller's afterwards.

        OpenCV's generator can be seeded but not read; that of the caller continues from a seed drawn from it.
        """
        with threads_kept(), preserve_process(self._device):
            give_threads(self._renderer)
            if not _generators_are_ours():
                yield
                return
            if self.random is None:
                random.seed(self._seed)
                np.random.seed(self._seed % 2**32)
                torch.manual_seed(self._seed)
            else:
                self.random.put(self._device)
            try:
                yield
            finally:
                now = RandomState.now(self._device)
                if self.random is None or not now.same(self.random):
                    self.random = now


def _generators_are_ours() -> bool:
    return threading.current_thread() is threading.main_thread()


def _same(a: Tensor | None, b: Tensor | None) -> bool:
    return a is b if a is None or b is None else torch.equal(a, b)


@contextmanager
def preserve_process(device: torch.device) -> Iterator[None]:
    """Afterwards the random generators are as before, and OpenCV has as many threads.

    OpenCV's generator is a thread's own; the others are left alone in another thread than the main one.
    """
    before = RandomState.now(device) if _generators_are_ours() else None
    threads = cv2.getNumThreads()
    drawn = np.zeros(1, np.int32)
    cv2.randu(drawn, -(2**31), 2**31 - 1)
    try:
        yield
    finally:
        if before is not None:
            before.put(device)
        cv2.setRNGSeed(int(drawn[0]))
        if cv2.getNumThreads() != threads:
            cv2.setNumThreads(threads)
