"""How long one iteration of a solver takes in the renderer, against a dense implementation of the same.

One forward pass renders a textured mesh of 2420 faces in all frames and evaluates the paper's losses: features,
silhouette, total variation of a 300 x 300 texture. One backward pass brings the gradients to vertices, texture and
poses. All backends solve the same problem in one process, turn by turn, so that a busy machine is as unkind to
one as to the other. The dense one, which takes its time, gets the first frame only; it works through the frames one
by one, so that all of them take as many times longer.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from tracking3d.errors import InputError
from tracking3d.estimation import losses
from tracking3d.evaluation.bench_dense import render_dense
from tracking3d.geometry.prototypes import sphere
from tracking3d.rendering import Rendering, channels_last, render, texture_losses

TEXTURE = 300
FREQUENCY = 11
BACKENDS: dict[str, Callable[..., Rendering]] = {
    "torch": partial(render, backend="torch"),
    "numba": partial(render, backend="numba"),
}
_CAUCHY_SCALE, _TOTAL_VARIATION_WEIGHT = 0.25, 0.001
_DENSE_EVERY = 10  # rounds in which the dense one takes part


@dataclass(frozen=True, eq=False)
class Scene:
    """One problem: what is rendered, and what it is compared with.

    Attributes:
        parameters: What gets gradients: vertices, texture, R and t of `render`.
        constants: Its other arguments.
        features: ``(B, C, H, W)`` observed.
        mask: ``(B, H, W)`` observed.
    """

    parameters: dict[str, Tensor]
    constants: dict[str, Any]
    features: Tensor
    mask: Tensor

    @classmethod
    def make(cls, size: int, frames: int, channels: int, device: torch.device) -> Scene:
        """An ellipsoid that turns by 10 degrees a frame and covers a quarter of ``size`` x ``size`` pixels."""
        generator = torch.Generator().manual_seed(0)
        mesh = sphere(FREQUENCY)
        vertices = torch.from_numpy(mesh.vertices).float() * torch.tensor([1.0, 0.8, 0.6])
        vertices += 0.01 * torch.randn(vertices.shape, generator=generator)
        turns = torch.deg2rad(torch.tensor([[3.0, 10.0, 1.0]]) * torch.arange(frames)[:, None])
        K = torch.tensor([[1.25 * size, 0, (size - 1) / 2], [0, 1.25 * size, (size - 1) / 2], [0, 0, 1]])
        parameters = {
            "vertices": vertices,
            "texture": channels_last(torch.rand(channels, TEXTURE, TEXTURE, generator=generator)),
            "R": axis_angle_to_rotation_matrix(turns),
            "t": torch.tensor([[0.0, 0.0, 4.0]]).repeat(frames, 1),
        }
        constants = {
            "faces": torch.from_numpy(mesh.faces).to(device),
            "face_uvs": torch.from_numpy(mesh.face_uvs).float().to(device),
            "K": K.repeat(frames, 1, 1).to(device),
            "size": (size, size),
        }
        y, x = torch.meshgrid(*[torch.linspace(-1, 1, size)] * 2, indexing="ij")
        mask = (x**2 + y**2 < 0.3).float().expand(frames, size, size)
        features = torch.rand(frames, channels, size, size, generator=generator)
        leaves = {name: value.to(device).requires_grad_() for name, value in parameters.items()}
        return cls(leaves, constants, channels_last(features).to(device), mask.to(device))

    def loss(self, backend: Callable[..., Rendering]) -> Tensor:
        """The paper's losses of the rendering by ``backend``."""
        drawn = backend(**self.parameters, **self.constants)
        valid = torch.ones_like(self.mask)
        pixel_loss, smooth = texture_losses(
            drawn.texture, drawn.uv, self.features, drawn.pixels, _CAUCHY_SCALE, backend=drawn.backend
        )
        appearance = losses.appearance_loss(pixel_loss, drawn.pixels, valid, _CAUCHY_SCALE).mean()
        silhouette = losses.iou_loss(drawn.silhouette, self.mask, valid).mean()
        return appearance + silhouette + _TOTAL_VARIATION_WEIGHT * smooth


def benchmark(
    size: int = 128,
    frames: int = 7,
    channels: int = 3,
    repeats: int = 5,
    device: str = "cpu",
    threads: int = 1,
) -> dict[str, Any]:
    """Time forward and backward passes of every backend on one problem.

    Args:
        size: Side of the windows in pixels.
        frames: Frames in the batch.
        channels: Channels of the texture.
        repeats: Measurements of each backend after a first one that does not count; the dense one takes part in
            every tenth.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        threads: CPU threads of all backends. Several gain little at these sizes and, on a machine that has other
            work to do, lose much by waiting for each other.

    Returns:
        The problem, where it ran (``threads``, ``device``), for each of ``backends`` and ``dense`` the median
        milliseconds ``forward_ms``, ``backward_ms`` and ``total_ms`` for all frames, with the number of
        ``measurements`` and of ``measured_frames``, from which they are scaled up, and ``speedup_over_dense``: how
        many times longer ``dense`` takes than ``torch``.

    Raises:
        InputError: If the device is not there.
    """
    place = torch.device(device)
    if place.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"the device '{device}' is not available: no CUDA GPU was found; use cpu")
    threads_before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        times = _measure_all(size, frames, channels, repeats, place)
    finally:
        torch.set_num_threads(threads_before)
    results = {
        name: _summary(measured, frames, frames) for name, measured in times.items() if name != "dense"
    }
    results["dense"] = _summary(times["dense"], frames, 1)
    return {
        "size": size,
        "frames": frames,
        "channels": channels,
        "faces": 20 * FREQUENCY**2,
        "texture": TEXTURE,
        "device": torch.cuda.get_device_name(place) if place.type == "cuda" else "cpu",
        "threads": threads,
        "backends": results,
        "speedup_over_dense": round(results["dense"]["total_ms"] / results["torch"]["total_ms"], 1),
    }


def _measure_all(
    size: int, frames: int, channels: int, repeats: int, place: torch.device
) -> dict[str, list[tuple[float, float]]]:
    """Milliseconds of forward and backward passes by name, the dense one's for a single frame."""
    scene, first = (Scene.make(size, count, channels, place) for count in (frames, 1))
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in (*BACKENDS, "dense")}
    for backend in BACKENDS.values():
        _measure(scene, backend)
    for turn in range(repeats):
        for name, backend in BACKENDS.items():
            times[name].append(_measure(scene, backend))
        if turn % _DENSE_EVERY == 0:
            times["dense"].append(_measure(first, render_dense))
    return times


def _measure(scene: Scene, backend: Callable[..., Rendering]) -> tuple[float, float]:
    """Milliseconds of one forward and of one backward pass."""
    for parameter in scene.parameters.values():
        parameter.grad = None
    start = _now(scene.mask)
    loss = scene.loss(backend)
    middle = _now(scene.mask)
    loss.backward()
    end = _now(scene.mask)
    return 1e3 * (middle - start), 1e3 * (end - middle)


def _now(tensor: Tensor) -> float:
    """Seconds, when all that was asked of the tensor's device is done."""
    if tensor.is_cuda:
        torch.cuda.synchronize(tensor.device)
    return time.perf_counter()


def _summary(measured: list[tuple[float, float]], frames: int, measured_frames: int) -> dict[str, float]:
    factor = frames / measured_frames
    forward, backward = (factor * statistics.median(part) for part in zip(*measured, strict=True))
    return {
        "forward_ms": round(forward, 2),
        "backward_ms": round(backward, 2),
        "total_ms": round(factor * statistics.median(map(sum, measured)), 2),
        "measurements": len(measured),
        "measured_frames": measured_frames,
    }
