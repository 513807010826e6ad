"""Guarded plug-ins: an error in one while it runs is reported as the error of that plug-in.

A guarded plug-in does what the bare one does. An exception in it, or a result that violates its protocol, becomes a
`PluginFailure`, which knows the plug-in's name, package and version.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.errors import PluginError, Tracking3dError
from tracking3d.features.protocol import FeatureEncoder, KeypointDetector, Keypoints
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.plugins.registration import describe_exception
from tracking3d.runtime.stage_times import in_stage
from tracking3d.trackers.protocol import (
    CorrectableTracker,
    ForewarnedTracker,
    MaskTracker,
    ResumableTracker,
    SparingTracker,
)


class PluginFailure(PluginError):
    """A plug-in failed while it ran.

    Args:
        plugin: Its name in messages, see `tracking3d.plugins.plugin_label`.
        fault: What went wrong, without a full stop.
        frame: Name of the frame in messages, if known.
    """

    def __init__(self, plugin: str, fault: str, frame: str = "") -> None:
        super().__init__(f"{plugin} failed{frame and f' at {frame}'}: {fault}.")
        self.plugin = plugin
        self.fault = fault

    @property
    def reason(self) -> str:
        """Plug-in and fault, without the frame and the full stop."""
        return f"{self.plugin} failed: {self.fault}"

    def at(self, frame: str) -> PluginFailure:
        """The same failure, with the frame in its message."""
        return PluginFailure(self.plugin, self.fault, frame)


class GuardedTracker:
    """A guarded mask tracker; wraps a `tracking3d.trackers.protocol.MaskTracker` and implements it.

    Args:
        tracker: The bare tracker.
        label: Its name in messages.
    """

    def __init__(self, tracker: MaskTracker, label: str) -> None:
        self._tracker = tracker
        self._label = label

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame.

        Raises:
            Tracking3dError: The tracker cannot start from this prompt; the message is its own.
            PluginFailure: It fails otherwise, or its result violates the protocol.
        """
        with in_stage("track"), _blame_plugin(self._label, but=Tracking3dError):
            answer = self._tracker.init(frame, prompt)
        return self._checked(answer, frame)

    def step(self, frame: Frame) -> MaskEstimate:
        """Track the next frame.

        Raises:
            PluginFailure: The tracker fails, or its result violates the protocol.
        """
        with in_stage("track"), _blame_plugin(self._label):
            answer = self._tracker.step(frame)
        return self._checked(answer, frame)

    @property
    def can_correct(self) -> bool:
        """Whether the tracker can be re-anchored; see `tracking3d.trackers.protocol.CorrectableTracker`."""
        return isinstance(self._tracker, CorrectableTracker)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Re-anchor the tracker on ``mask`` ``(H, W)`` in ``frame``, the latest one; does nothing if it cannot be.

        Raises:
            PluginFailure: The tracker fails.
        """
        if isinstance(self._tracker, CorrectableTracker):
            with in_stage("track"), _blame_plugin(self._label):
                self._tracker.correct(frame, mask.copy())

    def announce(self, frame: Frame) -> None:
        """Announce the frame that ``step`` is called with next; see `tracking3d.trackers.protocol.ForewarnedTracker`.

        Raises:
            PluginFailure: The tracker fails.
        """
        if isinstance(self._tracker, ForewarnedTracker):
            with in_stage("track"), _blame_plugin(self._label):
                self._tracker.announce(frame)

    @property
    def can_skip(self) -> bool:
        """Whether it need not be asked in every frame; see `tracking3d.trackers.protocol.SparingTracker`."""
        return isinstance(self._tracker, SparingTracker)

    def skip(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Tell the tracker where the object is in the next frame; does nothing if it has to be asked.

        Raises:
            PluginFailure: The tracker fails.
        """
        if isinstance(self._tracker, SparingTracker):
            with in_stage("track"), _blame_plugin(self._label):
                self._tracker.skip(frame, mask.copy())

    @property
    def can_resume(self) -> bool:
        """Whether the tracker's state can be saved; see `tracking3d.trackers.protocol.ResumableTracker`."""
        return isinstance(self._tracker, ResumableTracker)

    def state(self) -> Any:
        """The tracker's state; None if it cannot be saved.

        Raises:
            PluginFailure: The tracker fails.
        """
        if not isinstance(self._tracker, ResumableTracker):
            return None
        with _blame_plugin(self._label):
            return self._tracker.state()

    def restore(self, frame: Frame, prompt: Prompt, state: Any) -> None:
        """Restore the tracker's state; does nothing if it cannot be saved.

        Raises:
            PluginFailure: The tracker fails.
        """
        if isinstance(self._tracker, ResumableTracker):
            with _blame_plugin(self._label):
                self._tracker.restore(frame, prompt, state)

    def _checked(self, answer: Any, frame: Frame) -> MaskEstimate:
        if fault := mask_fault(answer, frame.size):
            raise PluginFailure(self._label, fault)
        mask: NDArray[np.float32] | None = answer.mask
        if mask is not None and mask.dtype != np.float32:
            mask = mask.astype(np.float32)
        return MaskEstimate(mask, float(answer.score), str(answer.reason), answer.occluder)


class GuardedEncoder:
    """A guarded feature encoder; wraps a `tracking3d.features.protocol.FeatureEncoder` and implements it.

    Other attributes of the encoder are passed through.

    Args:
        encoder: The bare encoder.
        label: Its name in messages.

    Raises:
        PluginError: Its channels, stride or tau are not positive numbers.
    """

    channels: int
    stride: int
    tau: float

    def __init__(self, encoder: FeatureEncoder, label: str) -> None:
        self._encoder = encoder
        self._label = label
        if fault := attribute_fault(encoder):
            raise PluginError(f"{label} is broken: {fault}.")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        value = getattr(self._encoder, name)
        if not callable(value):
            return value

        def guarded(*given: Any, **named: Any) -> Any:
            with _blame_plugin(self._label):
                return value(*given, **named)

        return guarded

    def encode(self, images: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` RGB in [0, 1]; no gradients are recorded.

        Raises:
            PluginFailure: The encoder fails, or its result violates the protocol.
        """
        with in_stage("encode"), _blame_plugin(self._label), torch.no_grad():
            features = self._encoder.encode(images)
        if fault := feature_fault(features, images, self._encoder):
            raise PluginFailure(self._label, fault)
        return features.detach()


class GuardedDetector:
    """A guarded keypoint detector; wraps a `tracking3d.features.protocol.KeypointDetector` and implements it."""

    def __init__(self, detector: KeypointDetector, label: str) -> None:
        self._detector, self._label = detector, label
        self.rotation_invariant = bool(detector.rotation_invariant)

    def detect(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_], most: int, contrast: float
    ) -> Keypoints:
        """As the detector; raises `PluginFailure` if that fails, or its result violates the protocol."""
        with _blame_plugin(self._label):
            found = self._detector.detect(image, mask, most, contrast)
        if fault := keypoint_fault(found, image.shape):
            raise PluginFailure(self._label, fault)
        return found


def keypoint_fault(found: Any, size: tuple[int, ...]) -> str:
    """Why these are not keypoints of a picture of ``size`` (H, W); empty if they are."""
    if not isinstance(found, Keypoints):
        return f"it returned {_kind(found)} instead of Keypoints"
    pixel, descriptor = np.asarray(found.pixel), np.asarray(found.descriptor)
    if pixel.shape != (len(pixel), 2) or descriptor.ndim != 2 or len(descriptor) != len(pixel):
        return f"its pixels have shape {pixel.shape} and its descriptors {descriptor.shape}, not (M, 2) and (M, D)"
    # Peaks between pixels may lie up to one beyond the border.
    inside = ((pixel >= -1) & (pixel <= size[::-1])).all()  # false for NaN too
    return (
        "" if inside and np.isfinite(descriptor).all() else "its keypoints are not finite and in the picture"
    )


def mask_fault(answer: Any, size: tuple[int, int]) -> str:
    """Why this is not a mask tracker's result for a frame of ``size`` ``(height, width)``; empty if it is."""
    if not isinstance(answer, MaskEstimate):
        return f"it returned {_kind(answer)} instead of a MaskEstimate"
    if not isinstance(answer.score, int | float | np.number) or not 0 <= answer.score <= 1:
        return f"its score is {answer.score!r} instead of a number from 0 to 1"
    occluder: Any = answer.occluder
    if occluder is not None and not (isinstance(occluder, np.ndarray) and occluder.dtype == np.bool_):
        return f"its occluder is {_kind(occluder)} instead of an array of bool"
    if occluder is not None and occluder.shape != size:
        return f"its occluder has shape {occluder.shape}, but the frame has ({size[0]}, {size[1]})"
    mask: Any = answer.mask
    if mask is None:
        return ""
    if not isinstance(mask, np.ndarray) or mask.dtype.kind not in "fbiu":
        return f"its mask is {_kind(mask)} instead of an array of float32"
    if mask.shape != size:
        return f"its mask has shape {mask.shape}, but the frame has ({size[0]}, {size[1]})"
    if mask.size and not (mask.min() >= 0 and mask.max() <= 1):  # false for NaN too
        return f"its mask has values from {mask.min():g} to {mask.max():g} instead of from 0 to 1"
    return ""


def attribute_fault(encoder: Any) -> str:
    """Why the attributes of a feature encoder cannot be used; empty if they can."""
    for name, kind in (("channels", int | np.integer), ("stride", int | np.integer), ("tau", int | float)):
        value = getattr(encoder, name, None)
        if not isinstance(value, kind) or isinstance(value, bool) or not 0 < value < float("inf"):
            what = "a positive number" if name == "tau" else "a positive integer"
            return f"its {name} is {value!r} instead of {what}"
    return ""


def feature_fault(features: Any, images: Tensor, encoder: FeatureEncoder) -> str:
    """Why these are not features of ``images`` ``(B, 3, H, W)`` by ``encoder``; empty if they are."""
    if not isinstance(features, Tensor) or not features.is_floating_point():
        return f"it returned {_kind(features)} instead of a tensor of float32"
    count, _, height, width = images.shape
    stride = encoder.stride
    # If the stride does not divide the size, the encoder may round either way.
    fits = features.ndim == 4 and all(
        abs(found - side / stride) < 1
        for found, side in zip(features.shape[2:], (height, width), strict=True)
    )
    if not fits or features.shape[:2] != (count, encoder.channels):
        expected = (count, encoder.channels, -(-height // stride), -(-width // stride))
        return (
            f"its features have shape {tuple(features.shape)} instead of {expected} (channels "
            f"{encoder.channels}, stride {stride})"
        )
    if features.device != images.device:
        return f"its features are on {features.device}, but the images on {images.device}"
    if not bool(features.isfinite().all()):
        return "its features are not all finite numbers"
    return ""


@contextmanager
def _blame_plugin(label: str, but: type[Exception] = PluginFailure) -> Iterator[None]:
    """Turn exceptions into failures of the plug-in, except those of the type ``but``."""
    try:
        yield
    except but:
        raise
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # some extensions raise what is not an `Exception`
        raise PluginFailure(label, describe_exception(error)) from error


def _kind(value: Any) -> str:
    if value is None:
        return "None"
    dtype = getattr(value, "dtype", None)
    return f"a {type(value).__name__}" + (f" of {dtype}" if dtype is not None else "")
