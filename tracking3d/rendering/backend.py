"""Which implementation renders: torch, which runs everywhere, or the Numba kernels for float32 on the CPU."""

from __future__ import annotations

import functools
import logging
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


def prepare_backend(backend: str, device: str, threads: int = 1) -> dict[str, str | int]:
    """Choose what renders float32 on a device, and give it its threads.

    With the Numba kernels torch itself gets one thread: its threads keep their cores busy while they wait for work,
    which costs the kernels more than torch gains.

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
    torch.set_num_threads(1 if chosen == "numba" else threads)
    if chosen == "numba":
        from tracking3d.rendering.kernels.threads import set_num_threads

        set_num_threads(threads)
    return {"backend": chosen, "reason": reason, "threads": threads}


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
