"""Measuring the renderer's backends turn by turn in one process, so that a busy machine is as unkind to all."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch

from tracking3d.errors import InputError
from tracking3d.rendering import prepare_backend, render
from tracking3d.rendering.backend import threads_kept, why_no_numba
from tracking3d_bench.speed.dense import render_dense
from tracking3d_bench.speed.scene import Backend, RenderScene, RenderWorkload

DENSE = "dense"
_PER_TURN = 3
_PAUSE = 0.02  # seconds in which torch's idle threads, which first keep their cores busy, fall asleep


@dataclass(frozen=True)
class Duration:
    """Milliseconds of one forward and of one backward pass, or medians of several."""

    forward: float
    backward: float
    total: float


def find_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        InputError: If it is not there.
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"--device '{name}' is no device of the renderer; choose cpu, cuda or cuda:N")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"--device '{name}' is not available: no such CUDA GPU was found; use cpu")
    return device


def backends(device: torch.device) -> dict[str, Backend]:
    """What can render on a device, by name; ``torch`` always can and comes first."""
    found: dict[str, Backend] = {"torch": partial(render, backend="torch")}
    if device.type == "cpu" and not why_no_numba():
        found["numba"] = partial(render, backend="numba")
    return found


def set_benchmark_threads(name: str, device: torch.device, threads: int) -> None:
    """What a run of the product with that backend and ``--threads`` does; see `prepare_backend`."""
    prepare_backend("numba" if name == "numba" else "torch", str(device), threads)


def time_backends(
    problem: RenderWorkload,
    device: torch.device,
    repeats: int,
    threads: int,
    dense: bool = False,
    others: Mapping[str, Backend] | None = None,
) -> dict[str, list[Duration]]:
    """Time every backend on one problem.

    A turn of a backend is one iteration that does not count, in which kernels are compiled and the processor's
    caches forget the turn before, and up to three that do: a solver, too, goes on with one backend.

    Args:
        problem: What to render.
        device: Where.
        repeats: Measurements of each backend.
        threads: CPU threads of every backend.
        dense: Whether to time the dense implementation, too, once and for a single frame.
        others: Further renderers to time besides those of `backends`, by name.

    Returns:
        Measurements by name.
    """
    scene, candidates = RenderScene.make(problem, device), {**backends(device), **(others or {})}
    times: dict[str, list[Duration]] = {name: [] for name in candidates}
    with threads_kept():
        for done in range(0, repeats, _PER_TURN):
            for name, backend in candidates.items():
                _begin_turn(name, device, threads)
                _measure(scene, backend)
                times[name] += [_measure(scene, backend) for _ in range(min(_PER_TURN, repeats - done))]
        if dense:
            _begin_turn(DENSE, device, threads)
            times[DENSE] = [_measure(RenderScene.make(replace(problem, frames=1), device), render_dense)]
    return times


def median(measured: list[Duration]) -> Duration:
    """The median of each of the three."""
    return Duration(
        *(statistics.median(getattr(one, part) for one in measured) for part in Duration.__annotations__)
    )


def _begin_turn(name: str, device: torch.device, threads: int) -> None:
    set_benchmark_threads(name, device, threads)
    if threads > 1:
        time.sleep(_PAUSE)


def _measure(scene: RenderScene, backend: Backend) -> Duration:
    device = scene.mask.device
    scene.forget_gradients()
    start = _now(device)
    loss = scene.loss(backend)
    middle = _now(device)
    loss.backward()
    end = _now(device)
    return Duration(1e3 * (middle - start), 1e3 * (end - middle), 1e3 * (end - start))


def _now(device: torch.device) -> float:
    """Seconds, when all that was asked of the device is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
