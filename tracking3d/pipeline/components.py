"""The components of a session: solver, feature encoder, keypoint detector, device; and the times of its estimates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import torch

from tracking3d.config.models import PipelineConfig, PluginChoice, RuntimeConfig
from tracking3d.errors import InputError, argument
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.features.sift import SIFT
from tracking3d.estimation.online.known_object import KnownObject, KnownObjectSolver
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.paper.solver import PaperSolver
from tracking3d.estimation.solver import Solver
from tracking3d.features.protocol import FeatureEncoder, KeypointDetector
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.plugins import FEATURES, KEYPOINTS, build_plugin, plugin_label
from tracking3d.plugins.guard import GuardedDetector, GuardedEncoder
from tracking3d.rendering.backend import choose_backend, threads_kept, why_no_numba
from tracking3d.runtime.isolation import preserve_process
from tracking3d.runtime.stage_times import StageTimes, Stopwatch

SOLVERS: dict[str, Callable[[PipelineConfig, Camera, FeatureEncoder], Solver[Any]]] = {
    "paper": PaperSolver,
    "online": OnlineSolver,
}
"""Solvers by the name that `solver.name` selects."""


def build_solver(
    config: PipelineConfig,
    camera: Camera,
    encoder: FeatureEncoder,
    detector: KeypointDetector,
    known: KnownObject | None,
) -> Solver[Any]:
    """The solver that a configuration names, for the object that is known, if there is one.

    Args:
        config: The pipeline.
        camera: The camera of the full frame.
        encoder: The feature encoder.
        detector: What finds keypoints.
        known: See `tracking3d.pipeline.known_object.load_known_object`.
    """
    if known is not None:
        return KnownObjectSolver(config, camera, encoder, known, detector)
    solver = SOLVERS[config.solver.name](config, camera, encoder)
    return replace(solver, detector=detector) if isinstance(solver, OnlineSolver) else solver


_CPU = argument("runtime.device 'cpu'", "--device cpu")


def build_encoder(config: PipelineConfig) -> FeatureEncoder:
    """The feature encoder that a configuration names, under guard.

    Raises:
        PluginError: If it is unknown or broken.
    """
    label = plugin_label(FEATURES, config.features.name)
    with threads_kept(), preserve_process(torch.device("cpu")):
        return cast(FeatureEncoder, GuardedEncoder(build_plugin(FEATURES, config.features), label))


def build_detector(config: PipelineConfig) -> KeypointDetector:
    """The keypoint detector that a configuration names, under guard.

    Raises:
        PluginError: If it is unknown or broken.
    """
    if config.keypoints == PluginChoice(name="sift"):
        return SIFT  # nothing needs to be looked up, which reads the metadata of all packages
    label = plugin_label(KEYPOINTS, config.keypoints.name)
    with threads_kept(), preserve_process(torch.device("cpu")):
        return cast(KeypointDetector, GuardedDetector(build_plugin(KEYPOINTS, config.keypoints), label))


def check_device(name: str) -> None:
    """Make sure that a device is there.

    Raises:
        InputError: If it is not.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"The device '{name}' is not available on this machine; use {_CPU}.") from error


def select_renderer(runtime: RuntimeConfig) -> dict[str, str | int]:
    """What renders, and why, see `tracking3d.rendering.backend.choose_backend`.

    Raises:
        InputError: If that cannot be used here, or Numba cannot, without whose kernels nothing can be tracked.
    """
    check_device(runtime.device)
    if why_no_numba():
        raise InputError(f"Tracking needs Numba to compile its kernels: {why_no_numba()}.")
    try:
        return choose_backend(runtime.renderer, runtime.device, runtime.threads)
    except ValueError as error:
        raise InputError(f"runtime.renderer: {error}.") from error


def check_backward_tracking(config: PipelineConfig) -> None:
    """Make sure that the solver can track backwards from the prompt frame.

    Raises:
        InputError: It cannot.
    """
    name = config.solver.name
    if not hasattr(SOLVERS[name], "restart_backwards"):
        turning = " or ".join(
            other for other, solver in SOLVERS.items() if hasattr(solver, "restart_backwards")
        )
        raise InputError(
            f"Solver '{name}' cannot track backwards. Use solver.name={turning}, or start at the prompt frame with "
            "--frames N:."
        )


def add_times(estimate: FrameEstimate, watch: Stopwatch, frame: Frame) -> FrameEstimate:
    """An estimate with what it took, reading the frame included."""
    stages = watch.times + StageTimes(decode=frame.decoding)
    return replace(estimate, stages=stages, seconds=stages.whole)
