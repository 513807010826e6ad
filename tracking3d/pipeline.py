"""The pipeline: builds the parts that a configuration names and sends frames through them.

>>> for estimate in track(frames, box=(x, y, w, h)):  # doctest: +SKIP
...     print(estimate.index, estimate.status, estimate.T_cam_obj)
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.loading import load_config
from tracking3d.config.models import CameraConfig, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.paper.solver import PaperSolver
from tracking3d.estimation.solver import Solver
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt, SkippedFrame
from tracking3d.geometry.camera import DEFAULT_FIELD_OF_VIEW, Camera
from tracking3d.plugins import FEATURES, TRACKERS, build_plugin, plugin_label
from tracking3d.plugins.guard import GuardedEncoder, GuardedTracker, PluginFailure
from tracking3d.prompts import make_prompt
from tracking3d.rendering import prepare_backend

SOLVERS: dict[str, type[PaperSolver]] = {"paper": PaperSolver}
"""Solvers by the name that `solver.name` selects."""


class Session:
    """One object tracked through one video: ``step`` takes each frame, ``result`` gives the object.

    Args:
        config: The pipeline.
        prompt: The object in the first frame; None takes the mask tracker's own first mask.
        intrinsics: fx, fy, cx, cy that the source knows of, in pixels; the configuration wins over them.
        intrinsics_origin: Where they come from, in words.

    Attributes:
        config: The pipeline.
        renderer: What renders, and why, see `tracking3d.rendering.prepare_backend`.

    Raises:
        PluginError: If a plug-in is unknown or broken.
        InputError: If an option cannot be used on this machine.
    """

    def __init__(
        self,
        config: PipelineConfig,
        prompt: Prompt | None,
        intrinsics: tuple[float, float, float, float] | None = None,
        intrinsics_origin: str = "",
    ) -> None:
        check_device(config.runtime.device)
        if config.solver.name not in SOLVERS:
            raise InputError(f"Unknown solver '{config.solver.name}'; choose one of {', '.join(SOLVERS)}.")
        if prompt is None and config.tracker.name != "precomputed":
            raise InputError("Say what the object is by either a box or a mask of the first frame.")
        runtime = config.runtime
        try:
            self.renderer = prepare_backend(runtime.renderer, runtime.device, runtime.threads)
        except ValueError as error:
            raise InputError(f"runtime.renderer: {error}.") from error
        self.config = config
        self._prompt = prompt
        self._intrinsics = intrinsics, intrinsics_origin
        self._tracker = GuardedTracker(
            build_plugin(TRACKERS, config.tracker), plugin_label(TRACKERS, config.tracker.name)
        )
        self._encoder = GuardedEncoder(
            build_plugin(FEATURES, config.features), plugin_label(FEATURES, config.features.name)
        )
        self._solver: Solver[Any] | None = None
        self._state: Any = None
        self._camera: Camera | None = None
        self._last_mask = MaskEstimate(None)
        self._last_pose = np.eye(4)
        self._failures: dict[int, str] = {}

    @property
    def camera(self) -> Camera:
        """The camera of the full frame, known from the first frame on."""
        if self._camera is None:
            raise RuntimeError("the camera is known after the first step")
        return self._camera

    def step(self, frame: Frame) -> FrameEstimate:
        """Track the object in the next frame; the first call starts on it.

        Raises:
            InputError: If the first frame has no object, or the frame has another size than the first.
            PluginError: If a plug-in fails: in the first frame, or with ``runtime.on_plugin_failure`` ``stop`` in
                any. With ``continue`` a later frame is answered with what there is, and ``failure`` says why.
        """
        try:
            return self._start(frame) if self._solver is None else self._go_on(self._solver, frame)
        except PluginFailure as error:
            raise error.at(_label(frame)) from error.__cause__

    def _start(self, frame: Frame) -> FrameEstimate:
        height, width = frame.size
        self._camera = choose_camera(self.config.camera, width, height, *self._intrinsics)
        torch.manual_seed(self.config.runtime.seed)
        mask = self._tracker.init(frame, self._prompt or Prompt((0.0, 0.0, float(width), float(height))))
        encoder = cast(FeatureEncoder, self._encoder)
        solver = SOLVERS[self.config.solver.name](self.config, self._camera, encoder)
        self._state, estimate = solver.init(frame, mask)
        self._solver, self._last_mask, self._last_pose = solver, mask, estimate.T_cam_obj
        return estimate

    def _go_on(self, solver: Solver[Any], frame: Frame) -> FrameEstimate:
        if frame.size != (self.camera.height, self.camera.width):
            raise InputError(
                f"{_label(frame)} has {_pixels(frame.size)} pixels but the first frame "
                f"{_pixels((self.camera.height, self.camera.width))}; all frames must have one size."
            )
        started = time.perf_counter()
        failures = []
        try:
            mask = self._last_mask = self._tracker.step(frame)
        except PluginFailure as error:
            failures.append(self._excused(error))
            mask = replace(self._last_mask, score=0.0, reason=error.reason)
        try:
            self._state, estimate = solver.step(self._state, frame, mask)
        except PluginFailure as error:
            failures.append(self._excused(error))
            estimate = unanswered(frame, mask, self._last_pose, time.perf_counter() - started)
        self._last_pose = estimate.T_cam_obj
        if failures:
            self._failures[frame.index] = "; ".join(failures)
        revised = tuple(self._with_failure(earlier) for earlier in estimate.revised)
        return self._with_failure(replace(estimate, revised=revised))

    def _excused(self, error: PluginFailure) -> str:
        """Why a plug-in failed, where the run goes on in spite of it."""
        if self.config.runtime.on_plugin_failure == "stop":
            raise error
        return error.reason

    def _with_failure(self, estimate: FrameEstimate) -> FrameEstimate:
        """The answer for a frame in which plug-ins failed says so, and is not relied on."""
        failure = self._failures.get(estimate.index)
        if failure is None:
            return estimate
        return replace(
            estimate,
            status=Status.UNCERTAIN if estimate.status is Status.TRACKED else estimate.status,
            reason="; ".join(filter(None, (failure, estimate.reason))),
            confidence=estimate.confidence / 2,
            failure=failure,
        )

    def result(self) -> ObjectModel:
        """The object as it is known now: one textured mesh."""
        if self._solver is None:
            raise RuntimeError("there is no object before the first step")
        return self._solver.result(self._state)


def track(
    frames: Iterable[Image | Frame | SkippedFrame],
    *,
    box: Box | None = None,
    mask: NDArray[np.bool_] | None = None,
    config: PipelineConfig | Path | str | None = None,
) -> Iterator[FrameEstimate]:
    """Track an object through frames; answers come as the frames do, memory is bounded by the keyframes.

    Args:
        frames: ``(H, W, 3)`` uint8 RGB arrays, or `Frame` objects; frames that could not be read are passed over.
        box: The object in the first frame, ``(x, y, width, height)`` in pixels.
        mask: The object in the first frame, ``(H, W)`` bool. Either a box or a mask is given, or neither where
            the tracker knows its masks (``precomputed``).
        config: The pipeline, or a YAML file of one; the default preset if None.

    Yields:
        One estimate a frame.

    Raises:
        Tracking3dError: If the input or the configuration cannot be used.
    """
    if config is not None and not isinstance(config, PipelineConfig | str | Path):
        raise InputError(
            f"config is a {type(config).__name__}; give a PipelineConfig (see load_config) or a YAML file."
        )
    if not isinstance(config, PipelineConfig):
        config = load_config(Path(config) if config is not None else None)
    session: Session | None = None
    for position, item in enumerate(frames):
        if isinstance(item, SkippedFrame):
            continue
        frame = item if isinstance(item, Frame) else Frame(position, item)
        frame = replace(frame, image=checked_image(frame.image, frame.index))
        if session is None:
            prompt = None if box is None and mask is None else make_prompt(frame, box, mask)
            session = Session(config, prompt)
        yield session.step(frame)


def checked_image(image: Image, position: int) -> Image:
    """A copy of an image that is ``(H, W, 3)`` uint8; callers like to decode every frame into one buffer.

    Raises:
        InputError: If it is not.
    """
    image = np.array(image, order="C")
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise InputError(
            f"Frame {position} has shape {image.shape} and type {image.dtype}; give (H, W, 3) arrays of uint8."
        )
    return image


def unanswered(
    frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64], seconds: float
) -> FrameEstimate:
    """The answer where the solver could give none: lost, with the initial mask and the pose known before."""
    initial = mask.binary if mask.binary is not None and mask.binary.any() else None
    return FrameEstimate(
        index=frame.index,
        time=frame.time,
        T_cam_obj=T_cam_obj,
        mask=initial if initial is not None else np.zeros(frame.size, dtype=np.bool_),
        initial_mask=initial,
        status=Status.LOST,
        reason="",
        confidence=0.0,
        seconds=seconds,
    )


def choose_camera(
    config: CameraConfig,
    width: int,
    height: int,
    known: tuple[float, float, float, float] | None = None,
    known_origin: str = "",
) -> Camera:
    """The camera by what is known best: given intrinsics, given field of view, the source's own, 45 degrees."""
    if config.intrinsics is not None:
        return Camera(*config.intrinsics, width, height, "given intrinsics")
    if config.fov is not None:
        return Camera.from_fov(width, height, config.fov, f"given field of view of {config.fov:g} degrees")
    if known is not None:
        return Camera(*known, width, height, known_origin)
    return Camera.from_fov(
        width, height, DEFAULT_FIELD_OF_VIEW, f"default field of view of {DEFAULT_FIELD_OF_VIEW:g} degrees"
    )


def check_device(name: str) -> None:
    """Make sure that a device is there.

    Raises:
        InputError: If it is not.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"The device '{name}' is not available on this machine; use --device cpu."
        ) from error


def _label(frame: Frame) -> str:
    return frame.name or f"frame {frame.index}"


def _pixels(size: tuple[int, int]) -> str:
    return f"{size[1]} x {size[0]}"
