"""A frame source from the caller's own frames in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image as Pillow
from torch import Tensor

from tracking3d.config.explain import a_kind
from tracking3d.errors import InputError
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.video.array_source import ArraySource
from tracking3d.video.image_file import read_image
from tracking3d.video.opening import open_source
from tracking3d.video.source import FrameSource, Intrinsics

WANTED = "(H, W, 3) arrays of uint8, RGB"
"""The input that messages ask for; the documentation names the other kinds."""


def validate_image(image: Any, position: int) -> Image:
    """An image as a new ``(H, W, 3)`` uint8 array; callers like to decode every frame into one buffer.

    Args:
        image: An ``(H, W, 3)`` uint8 array, RGB, or what numpy reads as one; a tensor, see `tensor_image`; a picture of
            Pillow, of whatever mode, as it is; or the path of an image file, which is turned upright.
        position: What number the frame has, for messages.

    Raises:
        InputError: If it is no image.
    """
    label = f"Frame {position}"
    if isinstance(image, str | Path):
        return read_image(Path(image).expanduser())
    if isinstance(image, Tensor):
        return tensor_image(image, label)
    try:
        if isinstance(image, Pillow.Image):
            image = image.convert("RGB")
        copy = np.array(np.asarray(image), order="C")
    except Exception as error:  # what a class makes of itself as an array can fail in any way
        raise InputError(f"{label} is {a_kind(image)}; give {WANTED}.") from error
    if copy.ndim == 0:
        raise InputError(f"{label} is {a_kind(image)}; give {WANTED}.")
    check_image(copy, label)
    return copy


def tensor_image(tensor: Tensor, label: str) -> Image:
    """A tensor of any device as a new array.

    Args:
        tensor: ``(3, H, W)`` or ``(H, W, 3)``; uint8, or of floats in [0, 1], which are rounded to 255ths.
        label: What messages call it.

    Raises:
        InputError: If it has another shape or type, or other values.
    """
    asked = f"give (3, H, W) or (H, W, 3), as uint8 or as floats in [0, 1], or {WANTED}"
    shape = tuple(tensor.shape)
    if len(shape) != 3 or 3 not in (shape[0], shape[2]) or not tensor.numel():
        raise InputError(f"{label} is a Tensor of shape {shape}; {asked}.")
    tensor = tensor.detach().cpu()
    if tensor.is_floating_point():
        tensor = tensor.float()
        low, high = (float(value) for value in torch.aminmax(tensor))
        if not (low >= 0 and high <= 1):  # nor NaN
            raise InputError(f"{label} is a Tensor of floats from {low:g} to {high:g}; {asked}.")
        tensor = (tensor * 255).round().to(torch.uint8)
    if tensor.dtype != torch.uint8:
        raise InputError(f"{label} is a Tensor of type {tensor.dtype}; {asked}.")
    upright = tensor if shape[2] == 3 else tensor.permute(1, 2, 0)
    image: Image = np.array(upright.numpy(), order="C")
    return image


def check_image(image: Any, label: str) -> None:
    """Make sure that an image is ``(H, W, 3)`` uint8.

    Raises:
        InputError: If it is not.
    """
    if not isinstance(image, np.ndarray):
        raise InputError(f"{label} is {a_kind(image)}; give {WANTED}.")
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise InputError(f"{label} has shape {image.shape} and type {image.dtype}; give {WANTED}.")


_KINDS = f"{WANTED}, tensors, Pillow images or paths of images; or the path of a video or folder"


def open_frames(frames: Any) -> FrameSource:
    """A source of what `tracking3d.track` was given; what can be seen without taking a frame is seen now.

    Args:
        frames: A source already; what `tracking3d.video.open_source` opens by a path; a ``cv2.VideoCapture``; an array
            ``(N, H, W, 3)`` of uint8; a tensor ``(N, 3, H, W)`` or ``(N, H, W, 3)`` of uint8 or of floats in [0, 1]; or
            any iterable of what `tracking3d.video.in_memory.validate_image` takes, and of `Frame` and `SkippedFrame`.

    Raises:
        InputError: If it is nothing of that.
    """
    if isinstance(frames, str | Path):
        return open_source(frames)
    if isinstance(frames, cv2.VideoCapture):
        return CapturedFrames.of(frames)
    shape = tuple(getattr(frames, "shape", None) or ())
    if isinstance(frames, Tensor):
        if len(shape) != 4 or 3 not in (shape[1], shape[3]):
            raise InputError(
                f"frames= is a Tensor of shape {shape}; give (N, 3, H, W) or (N, H, W, 3), as uint8 or as floats in "
                "[0, 1]."
            )
    elif getattr(frames, "shape", None) is not None and (
        len(shape) != 4 or shape[3] != 3 or str(getattr(frames, "dtype", "")).rpartition(".")[2] != "uint8"
    ):
        raise InputError(
            f"frames= is {a_kind(frames)} of shape {shape} and type {getattr(frames, 'dtype', '?')}; "
            f"give {WANTED}, one after the other or as one array (N, H, W, 3)."
        )
    if not isinstance(frames, Iterable) or isinstance(frames, Mapping | type | bytes):
        raise InputError(f"frames= is {a_kind(frames)}; give {_KINDS}.")
    if isinstance(frames, FrameSource):
        return frames
    if isinstance(frames, Sequence | Tensor) and len(frames):
        next(
            iter(ArraySource(frames[:1], convert=validate_image))
        )  # what is wrong with all of them is said at once
    return ArraySource(frames, convert=validate_image)


@dataclass(eq=False)
class CapturedFrames:
    """The frames that a ``cv2.VideoCapture`` of the caller's still has; it is left open.

    One of a file is taken back to where it stood when it was given, to be read again; that the first frame is then the
    same is made sure of. See `tracking3d.video.source.FrameSource` for the attributes.
    """

    capture: cv2.VideoCapture
    start: int
    count: int | None
    fps: float | None
    name: str = "the VideoCapture"
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    _first: Image | None = field(default=None, repr=False)

    @classmethod
    def of(cls, capture: cv2.VideoCapture) -> CapturedFrames:
        """A source of what is left of a capture.

        Raises:
            InputError: If it is not open.
        """
        if not capture.isOpened():
            raise InputError("frames= is a VideoCapture that is not open; open it with a file or camera.")
        length, start = (
            int(capture.get(what)) for what in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_POS_FRAMES)
        )
        rate = capture.get(cv2.CAP_PROP_FPS)
        return cls(
            capture, max(start, 0), length - start if length > start else None, rate if rate > 0 else None
        )

    @property
    def indices(self) -> range | None:
        """Indices of the frames, if it is one of a file."""
        return None if self.count is None else range(self.count)

    @property
    def repeatable(self) -> bool:
        """Whether it is one of a file."""
        return self.count is not None

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Read to the end; indices count from the frame at which the capture stood.

        Raises:
            InputError: If there is none, or going back did not lead to the same frame.
        """
        if self._first is not None and self.repeatable:
            self.capture.set(cv2.CAP_PROP_POS_FRAMES, self.start)
        index = 0
        while True:
            there, image = self.capture.read()
            if not there:
                break
            rgb: Image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)
            if index == 0:
                if self._first is None:
                    self._first = rgb
                elif self.repeatable and not np.array_equal(self._first, rgb):
                    raise InputError(
                        f"{self.name} cannot be rewound to frame {self.start}: another image is there; give "
                        "the path of the video."
                    )
            yield Frame(index, rgb, time=index / self.fps if self.fps else None, name=f"frame {index}")
            index += 1
        if not index:
            raise InputError(f"{self.name} has no readable frame left.")
