"""Sharing a kernel's work among as many threads as torch uses (`torch.set_num_threads`)."""

from __future__ import annotations

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

from tracking3d.rendering.kernels.compilation import Kernel


def share(kernel: Kernel, count: int, least: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments, first, last)`` on ranges that make up ``range(count)``.

    Args:
        kernel: Releases the GIL; calls for different ranges write to different places.
        count: How many items there are.
        least: Fewest items for which waking another thread pays.
        *arguments: Come before the range.
    """
    threads = min(torch.get_num_threads(), count // least)
    if threads <= 1:
        kernel(*arguments, 0, count)
        return
    bounds = [count * part // threads for part in range(threads + 1)]
    others = [
        _pool(threads - 1).submit(kernel, *arguments, first, last)
        for first, last in zip(bounds[1:-1], bounds[2:], strict=True)
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
