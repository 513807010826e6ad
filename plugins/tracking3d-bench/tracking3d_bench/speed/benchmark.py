"""How long one iteration of a solver takes in the renderer, against a dense implementation of the same.

One forward pass renders a textured mesh of 2420 faces in all frames and evaluates the paper's losses: features,
silhouette, total variation of the texture. One backward pass brings the gradients to vertices, texture and poses.
All backends solve the same problem in one process, turn by turn, so that a busy machine is as unkind to one as to
the other. The dense one, which takes its time, gets the first frame only, and once; it works through the frames one
by one, so that all of them take as many times longer.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from tracking3d.results.description import versions
from tracking3d_bench.speed.growth import measure_growth
from tracking3d_bench.speed.memory import peak_memory
from tracking3d_bench.speed.scene import Backend, RenderWorkload, default_texture
from tracking3d_bench.speed.timing import DENSE, Duration, find_device, median, time_backends


def benchmark(
    size: int = 128,
    frames: int = 7,
    channels: int = 3,
    texture: int | None = None,
    repeats: int = 15,
    threads: int = 1,
    device: str = "cpu",
    dense: bool = True,
    growth: bool = False,
    others: Mapping[str, Backend] | None = None,
) -> dict[str, Any]:
    """Time forward and backward passes of every backend on one problem.

    Args:
        size: Side of the windows in pixels.
        frames: Frames in the batch.
        channels: Channels of the texture.
        texture: Side of the texture in texels; by default 300 up to 16 channels and 150 above.
        repeats: Measurements of each backend.
        threads: CPU threads of every backend, as ``--threads`` of a run gives them. Several gain little at these
            sizes and, on a machine that has other work to do, lose much by waiting for each other.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        dense: Whether to time the dense implementation, too, which takes most of the time.
        growth: Whether to measure how the times grow with the problem, see `measure_growth`.
        others: Further renderers to time, by name; their memory and growth are not measured.

    Returns:
        The problem, where it ran (``threads``, ``device``, ``machine``), and for each of ``backends`` the median
        milliseconds ``forward_ms``, ``backward_ms`` and ``total_ms`` for all frames, with the number of
        ``measurements`` and of ``measured_frames``, from which they are scaled up; ``ratio_to_torch``, its
        ``total_ms`` over that of ``torch``; ``speedup_over_dense``, how many times longer ``dense`` takes, None if it
        was not asked for; ``peak_memory_mb``, see `peak_memory`, None for ``dense`` and ``others``.
        ``speedup_over_dense`` of ``torch`` stands outside, too. With ``growth`` the result of `measure_growth`.

    Raises:
        InputError: If the device is not there.
    """
    place = find_device(device)
    problem = RenderWorkload(size, frames, channels, texture or default_texture(channels))
    times = time_backends(problem, place, repeats, threads, dense, others)
    results = {
        name: _figures(measured, frames, 1 if name == DENSE else frames) for name, measured in times.items()
    }
    for name, figures in results.items():
        figures["ratio_to_torch"] = _ratio(figures, results["torch"])
        figures["speedup_over_dense"] = _ratio(results[DENSE], figures) if dense else None
        apart = name == DENSE or name in (others or {})
        figures["peak_memory_mb"] = None if apart else _round(name, problem, place, threads)
    report = {
        **{name: value for name, value in asdict(problem).items() if name != "frequency"},
        "faces": problem.faces,
        "device": torch.cuda.get_device_name(place) if place.type == "cuda" else "cpu",
        "threads": threads,
        "machine": machine(),
        "backends": results,
        "speedup_over_dense": results["torch"]["speedup_over_dense"],
    }
    if growth:
        report["growth"] = measure_growth(problem, place, repeats, threads)
    return report


def machine() -> dict[str, Any]:
    """Model and cores of the CPU, and the versions of torch and numba."""
    known = versions()
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "torch": known["torch"],
        "numba": known["numba"],
    }


def _cpu_model() -> str:
    described = Path("/proc/cpuinfo")
    if described.exists():
        for line in described.read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def _figures(measured: list[Duration], frames: int, measured_frames: int) -> dict[str, Any]:
    factor, middle = frames / measured_frames, median(measured)
    return {
        "forward_ms": round(factor * middle.forward, 2),
        "backward_ms": round(factor * middle.backward, 2),
        "total_ms": round(factor * middle.total, 2),
        "measurements": len(measured),
        "measured_frames": measured_frames,
    }


def _ratio(one: dict[str, Any], other: dict[str, Any]) -> float:
    """How many times as long one takes as the other, to three digits."""
    return float(f"{one['total_ms'] / other['total_ms']:.3g}")


def _round(name: str, problem: RenderWorkload, device: torch.device, threads: int) -> float:
    return round(peak_memory(name, problem, device, threads), 1)
