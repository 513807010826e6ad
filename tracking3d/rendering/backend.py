"""Which implementation renders: torch, which runs everywhere, or the Numba kernels for float32 on the CPU."""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

import torch
from torch import Tensor

BackendName = Literal["auto", "torch", "numba"]
"""``auto`` takes the Numba kernels wherever they can run."""

_log = logging.getLogger("tracking3d.rendering")


def use_numba(backend: str, *tensors: Tensor) -> bool:
    """Whether tensors are to be rendered by the Numba kernels, and not by torch.

    Args:
        backend: See `BackendName`.
        *tensors: All that is to be rendered, of floating-point types.

    Raises:
        ValueError: If Numba is asked for but cannot render these tensors, or there is no such backend.
    """
    if backend == "torch":
        return False
    fits = all(tensor.dtype is torch.float32 and tensor.is_cpu for tensor in tensors)
    if backend == "auto":
        return fits and not why_no_numba()
    if backend != "numba":
        raise ValueError(f"there is no backend '{backend}'; choose auto, torch or numba")
    if why_no_numba():
        raise ValueError(f"the backend 'numba' cannot be used: {why_no_numba()}; choose auto or torch")
    if not fits:
        found = ", ".join(sorted({f"{tensor.dtype} on {tensor.device.type}" for tensor in tensors}))
        raise ValueError(
            f"the backend 'numba' renders torch.float32 on cpu, not {found}; choose auto or torch"
        )
    return True


def choose_backend(backend: str, device: str, threads: int = 1) -> dict[str, str | int]:
    """Choose what renders float32 on a device.

    Args:
        backend: See `BackendName`.
        device: As torch writes it.
        threads: CPU threads. One is the best choice for several processes on one machine.

    Returns:
        ``backend`` that will render, the ``reason`` why, and its ``threads``, for the record of a run.

    Raises:
        ValueError: If Numba is asked for but cannot be used.
    """
    place = torch.device(device).type
    if threads < 1:
        raise ValueError(f"the number of threads is {threads}; give one or more")
    if place == "cpu" or backend not in ("auto", "torch", "numba"):
        chosen = "numba" if use_numba(backend, torch.empty(0, dtype=torch.float32)) else "torch"
    elif backend == "numba":
        raise ValueError(f"the backend 'numba' renders on the cpu, not on {device}; choose auto or torch")
    else:
        chosen = "torch"
    reason = "asked for"
    if backend == "auto":
        reason = why_no_numba() or f"{chosen} is the fastest on {place}"
        if place == "cpu" and why_no_numba():
            _log.warning("Torch renders, several times slower than the compiled kernels: %s.", why_no_numba())
    return {"backend": chosen, "reason": reason, "threads": threads}


def prepare_backend(backend: str, device: str, threads: int = 1) -> dict[str, str | int]:
    """Choose what renders float32 on a device, and give it its threads; see `choose_backend`."""
    renderer = choose_backend(backend, device, threads)
    give_threads(renderer)
    return renderer


def give_threads(renderer: Mapping[str, str | int]) -> None:
    """Give what was chosen its threads.

    With the Numba kernels torch itself gets one thread: its threads keep their cores busy while they wait for work,
    which costs the kernels more than torch gains.

    Args:
        renderer: What `choose_backend` returned.
    """
    threads = int(renderer["threads"])
    by_kernels = renderer["backend"] == "numba"
    _set_torch_threads(1 if by_kernels else threads)
    if by_kernels:
        from tracking3d.rendering.kernels.compilation import set_num_threads

        set_num_threads(threads)


@contextmanager
def threads_kept() -> Iterator[None]:
    """Afterwards torch and the kernels have as many threads as before."""
    of_torch, of_kernels = torch.get_num_threads(), _kernels_threads()
    try:
        yield
    finally:
        _set_torch_threads(of_torch)
        if _kernels_threads() != of_kernels:
            from tracking3d.rendering.kernels.compilation import set_num_threads

            set_num_threads(of_kernels)


@contextmanager
def share_threads(threads: int) -> Iterator[None]:
    """Within, kernels share their work among so many threads, and torch has one.

    For work that is done once, when no frame waits.
    """
    with threads_kept():
        give_threads({"backend": "numba", "threads": max(threads, 1)})
        yield


def _kernels_threads() -> int:
    """Threads of the kernels; the default if nobody has imported them, which takes its time."""
    module = sys.modules.get("tracking3d.rendering.kernels.compilation")
    return int(module.get_num_threads()) if module else 1


def _set_torch_threads(threads: int) -> None:
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)


@functools.cache
def why_no_numba() -> str:
    """Why the kernels cannot be used on this machine; empty if they can."""
    try:
        import numba
    except Exception as error:  # an installation that does not fit fails in many ways
        return f"numba cannot be imported ({type(error).__name__}: {error})"
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return "NUMBA_DISABLE_JIT is set, and without being compiled the kernels take hours"
    return ""
