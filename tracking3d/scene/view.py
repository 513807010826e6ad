"""A frame seen through a window: what is there in two dimensions, and where the object is in space."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import NEAR, Camera, Window, pixel_distance

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Plane = NDArray[np.float32]

_MIXED = (1.5, 4.5)
"""Pixels within the outline up to which, and from which on, colours are the background's and the object's."""


@dataclass(frozen=True, eq=False)
class FrameCrop:
    """A frame seen through a window of ``(h, w)`` pixels."""

    window: Window  # of the frame
    image: NDArray[Any]  # (h, w, 3) uint8 RGB; (h, w) grey values where points are followed
    frame_size: tuple[int, int]  # (H, W) of the frame
    # (h, w) the object: bool; where points are followed how far, uint8 to 255 or float32 to 1. None if it is not known
    mask: NDArray[Any] | None = None
    index: int = -1  # of the frame, where it matters

    @classmethod
    def of(cls, frame: Image, window: Window) -> Self:
        """See ``frame`` ``(H, W, 3)`` RGB through ``window``."""
        return cls(window, crop_window(frame, window), frame.shape[:2])

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """``(h, w)``."""
        return cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY)

    @cached_property
    def lab(self) -> NDArray[np.uint8]:
        """``(h, w, 3)`` 8-bit CIE Lab."""
        return cv2.cvtColor(self.image, cv2.COLOR_RGB2LAB)

    @cached_property
    def in_frame(self) -> Mask:
        """``(h, w)`` what is not beyond the frame."""
        return inside_frame(self.frame_size, self.window)

    def to_window(self, xy: Array) -> Array:
        """Pixels ``(..., 2)`` of the frame as pixels of the window."""
        return (xy + 0.5 - np.array([self.window.left, self.window.top])) * self.window.scales - 0.5

    def to_frame(self, xy: Array) -> Array:
        """Pixels ``(..., 2)`` of the window as pixels of the frame."""
        return (xy + 0.5) / self.window.scales - 0.5 + np.array([self.window.left, self.window.top])


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectView(FrameCrop):
    """The object in a frame, seen through a window of it. All pixels are the window's; see `to_frame`."""

    mask: NDArray[Any]
    K: Array  # (3, 3) intrinsics of the window
    T_cam_obj: Array  # (4, 4); NaN if there is no pose that is trusted
    # (h, w) the mask tracker's mask; (0, 0) where it does not matter
    initial: Mask = field(default_factory=lambda: np.zeros((0, 0), bool))
    occluder: Mask | None = None  # (h, w) what is in front of the object; None if nothing is known
    confidence: float = 1.0  # of the pose, in [0, 1]

    @classmethod
    def of_frame(
        cls, index: int, image: Image, mask: Mask, camera: Camera, T_cam_obj: Array, **known: Any
    ) -> Self:
        """A whole frame, which `at` cuts out.

        Args:
            index: Index of the frame.
            image: ``(H, W, 3)`` RGB.
            mask: ``(H, W)`` the object.
            camera: Camera of the frame.
            T_cam_obj: ``(4, 4)``.
            known: Further fields, ``(H, W)`` if they are masks.
        """
        height, width = mask.shape
        window, pose = Window(0, 0, width, width, (height, height)), np.array(T_cam_obj, np.float64)
        return cls(
            window, image, (height, width), index=index, mask=mask, K=camera.K, T_cam_obj=pose, **known
        )

    def at(self, window: Window) -> Self:
        """What ``window`` sees of this view, which is of a whole frame."""
        inside = inside_frame(self.frame_size, window)
        masks = {"mask": self.mask, "initial": self.initial, "occluder": self.occluder}
        seen: dict[str, Any] = {
            name: (crop_window(mask, window) > 0.5) & inside
            for name, mask in masks.items()
            if mask is not None and mask.size
        }
        image, K = crop_window(self.image, window), window.through(self.K)
        return replace(self, window=window, image=image, K=K, **seen)

    @cached_property
    def signed_distance(self) -> Plane:
        """``(h, w)`` pixels from the mask's outline, half-way between pixels inside and outside; positive inside."""
        inside: Plane = pixel_distance(~self.mask) - 0.5
        return np.where(self.mask, inside, 0.5 - pixel_distance(self.mask)).astype(np.float32)

    @cached_property
    def interior(self) -> Plane:
        """``(h, w)`` in [0, 1], how far each pixel is surely the object's; at the outline colours are mixed."""
        depth = cv2.distanceTransform(self.mask.astype(np.uint8), cv2.DIST_L2, 5)
        return np.clip((depth - _MIXED[0]) / (_MIXED[1] - _MIXED[0]), 0.0, 1.0).astype(np.float32)

    @cached_property
    def sharpness(self) -> float:
        """Share of the contrast within the object that is in the finest details; larger is sharper."""
        grey, within = self.grey.astype(np.float32), self.interior > 0.5
        if not within.any():
            return 0.0
        fine = cv2.Laplacian(grey, cv2.CV_32F)[within]
        return float(np.mean(np.square(fine)) / (np.var(grey[within]) + 1.0))

    @property
    def frame_edges(self) -> Plane:
        """``(4,)`` left, right, top and bottom edge of the frame in the window's pixels."""
        (height, width), (across, down) = self.frame_size, self.window.scales
        columns, rows = np.array([0, width]) - self.window.left, np.array([0, height]) - self.window.top
        return (np.concatenate([columns * across, rows * down]) - 0.5).astype(np.float32)

    @property
    def P(self) -> Array:
        """``(3, 4)`` from object coordinates to pixels of the window, times the depth."""
        return np.asarray(self.K @ self.T_cam_obj[:3])

    @property
    def direction(self) -> Array:
        """``(3,)`` unit vector from the object's origin to the camera, in object coordinates."""
        towards = -self.T_cam_obj[:3, :3].T @ self.T_cam_obj[:3, 3]
        return np.asarray(towards / max(float(np.linalg.norm(towards)), 1e-12))

    @property
    def intrinsics(self) -> Array:
        """``(4,)`` fx, fy, cx, cy of the window."""
        return self.K[[0, 1, 0, 1], [0, 1, 2, 2]]

    def project(self, points: Array) -> tuple[Array, Array]:
        """Object points ``(N, 3)`` as ``(N, 2)`` pixels, NaN behind the camera, and ``(N,)`` depths."""
        return project_points(points, self.K, self.T_cam_obj)

    def back_project(self, xy: Array, inverse_depth: NDArray[np.floating]) -> Array:
        """Pixels ``(N, 2)`` at one over their depths ``(N,)`` as object points ``(N, 3)``; NaN if that is 0."""
        depth = 1 / np.where(inverse_depth > 0, inverse_depth, np.nan).astype(np.float64)
        fx, fy, cx, cy = self.intrinsics
        seen = np.stack([(xy[:, 0] - cx) / fx * depth, (xy[:, 1] - cy) / fy * depth, depth], 1)
        points: Array = (seen - self.T_cam_obj[:3, 3]) @ self.T_cam_obj[:3, :3]
        return points


def project_points(points: Array, K: Array, T_cam_obj: Array) -> tuple[Array, Array]:
    """Object points ``(N, 3)`` as ``(N, 2)`` pixels, NaN behind the camera, and ``(N,)`` depths."""
    seen = points @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    depth = seen[:, 2]
    with np.errstate(invalid="ignore"):
        ahead = np.where(depth > NEAR, depth, np.nan)
    return np.stack(
        [K[0, 0] * seen[:, 0] / ahead + K[0, 2], K[1, 1] * seen[:, 1] / ahead + K[1, 2]], 1
    ), depth


def crop_window(image: NDArray, window: Window) -> NDArray:
    """What ``window`` sees of ``image`` ``(H, W)`` or ``(H, W, C)``, resampled to ``(h, w[, C])``.

    The part of the window beyond the frame repeats the frame's border. A mask becomes float32.
    """
    (height, width), (rows_seen, columns_seen) = window.sides, window.shape
    rows, above, below = _span(window.top, height, image.shape[0])
    columns, before, after = _span(window.left, width, image.shape[1])
    region = image[rows, columns]
    if region.dtype == np.bool_:
        region = region.astype(np.float32)
    if above or below or before or after:
        region = cv2.copyMakeBorder(region, above, below, before, after, cv2.BORDER_REPLICATE)
    smaller = rows_seen < height or columns_seen < width
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return cv2.resize(region, (columns_seen, rows_seen), interpolation=method)


def _span(first: int, count: int, size: int) -> tuple[slice, int, int]:
    """What of ``count`` places from ``first`` on lies in ``range(size)``, one at least; how many before and after."""
    begin, end = min(max(first, 0), size - 1), max(min(first + count, size), 1)
    end = max(end, begin + 1)
    before = min(max(-first, 0), count - 1)
    return slice(begin, end), before, count - (end - begin) - before


def inside_frame(shape: tuple[int, ...], window: Window) -> Mask:
    """``(h, w)``: which pixels of ``window`` lie inside a frame of ``shape`` ``(H, W, ...)``."""
    across, down = window.scales
    rows = window.top + (np.arange(window.shape[0]) + 0.5) / down
    columns = window.left + (np.arange(window.shape[1]) + 0.5) / across
    return ((rows > 0) & (rows < shape[0]))[:, None] & ((columns > 0) & (columns < shape[1]))
