"""Sharing a kernel's work among threads.

Their number is a setting of the process, as torch's is, and independent of it: threads of torch that wait for
work keep their cores busy, so that both together are slower than either. What a thread other than the main one sets
holds for itself alone, so that two may track without knowing of each other.
"""

from __future__ import annotations

import functools
import itertools
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from tracking3d.rendering.kernels.compilation import Kernel

_threads = 1
_of_thread = threading.local()


def set_num_threads(threads: int) -> None:
    """Let kernels use this many threads; the default is one.

    Raises:
        ValueError: If it is less than one.
    """
    global _threads
    if threads < 1:
        raise ValueError(f"the number of threads is {threads}; give one or more")
    if threading.current_thread() is threading.main_thread():
        _threads = threads
    else:
        _of_thread.threads = threads


def get_num_threads() -> int:
    """How many threads kernels may use."""
    own: int = getattr(_of_thread, "threads", _threads)
    return own


def share(kernel: Kernel, count: int, least: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments, first, last)`` on ranges that make up ``range(count)``.

    Args:
        kernel: Releases the GIL; calls for different ranges write to different places.
        count: How many items there are.
        least: Fewest items for which waking another thread pays.
        *arguments: Come before the range.
    """
    threads = min(get_num_threads(), count // least)
    if threads <= 1:
        kernel(*arguments, 0, count)
        return
    bounds = [count * part // threads for part in range(threads + 1)]
    others = [
        _pool(threads - 1).submit(kernel, *arguments, first, last)
        for first, last in itertools.pairwise(bounds[1:])
    ]
    kernel(*arguments, bounds[0], bounds[1])
    for other in others:
        other.result()


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "tracking3d-rendering")


# The threads of a pool do not survive a fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
