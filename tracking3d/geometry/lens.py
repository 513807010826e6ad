"""What a lens does to a picture: a pinhole camera's pixels to those that were taken, and back.

The two models of OpenCV, in normalised coordinates ``x = X / Z``, ``y = Y / Z`` with ``r = sqrt(x^2 + y^2)``:

- ``radtan`` (Brown-Conrady, with OpenCV's rational and thin prism terms): ``k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2,
  s3, s4[, tx, ty]]]]``, https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html
- ``fisheye`` (Kannala-Brandt, Kalibr's ``equidistant``): ``k1, k2, k3, k4`` of the angle ``theta = atan r``, which is
  seen at ``theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)``,
  https://docs.opencv.org/4.x/db/d58/group__calib3d__fisheye.html
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError

Model = Literal["radtan", "fisheye"]
Pinhole = tuple[float, float, float, float]
"""``(fx, fy, cx, cy)`` in pixels."""

COUNTS: dict[Model, tuple[int, ...]] = {"radtan": (4, 5, 8, 12, 14), "fisheye": (4,)}
"""How many coefficients a model can have."""
LEAST_ZOOM = 0.5
"""A lens that is so wide that more would be needed to keep all of its picture loses its corners."""
_WIDEST = np.tan(np.radians(80.0))  # of what a pinhole picture can still show to any use
_LEAST_KEPT = 0.4
_EVERY = 4  # pixels between border points that decide on the zoom
_STEP = 4  # pixels; a power of two below 32, whose parts are exact in OpenCV's interpolation
_NOWHERE = -1e4  # pixels; where nothing is seen


@dataclass(frozen=True)
class Lens:
    """A lens with distortion, and the pinhole camera that its pictures are turned into.

    Both kinds of pictures have the same size. The pinhole camera has the lens's principal point and focal lengths as
    much shorter as it takes to see all of the picture, see `LEAST_ZOOM`.

    Attributes:
        model: Which formula.
        coefficients: Its coefficients, in OpenCV's order.
        picture: Intrinsics of the pictures as they were taken.
        pinhole: Intrinsics of the pinhole camera.
        width, height: Size of both in pixels.
    """

    model: Model
    coefficients: tuple[float, ...]
    picture: Pinhole
    pinhole: Pinhole
    width: int
    height: int

    @classmethod
    def of(
        cls, model: Model, coefficients: tuple[float, ...], picture: Pinhole, width: int, height: int
    ) -> Lens:
        """The lens, with the pinhole camera that fits it.

        Raises:
            InputError: If no lens has such coefficients: its picture folds over within its first half.
        """
        lens = cls(model, coefficients, picture, picture, width, height)
        fx, fy, cx, cy = picture
        column, row = np.arange(0, width, _EVERY), np.arange(0, height, _EVERY)
        border = np.concatenate(
            [np.stack([column, np.full_like(column, y)], 1) for y in (0, height - 1)]
            + [np.stack([np.full_like(row, x), row], 1) for x in (0, width - 1)]
        )
        seen = lens.to_pinhole(border) - (cx, cy)
        room = np.where(seen < 0, (cx, cy), (width - 1 - cx, height - 1 - cy))
        with np.errstate(divide="ignore", invalid="ignore"):
            zooms = np.where(np.abs(seen) > 1, room / np.abs(seen), 1.0)
        # What folds over or looks behind cannot be kept; the rest decides.
        zooms = zooms[np.isfinite(zooms).all(1)]
        zoom = float(np.clip(zooms.min(initial=1.0), LEAST_ZOOM, 1.0))
        lens = cls(model, coefficients, picture, (zoom * fx, zoom * fy, cx, cy), width, height)
        if lens.kept < _LEAST_KEPT:
            raise InputError(
                f"The distortion {', '.join(f'{one:g}' for one in coefficients)} folds pictures of {width} x {height} "
                "pixels over, as no lens does; give the coefficients in OpenCV's order, of a camera of that size."
            )
        return lens

    @property
    def kept(self) -> float:
        """Share of the picture, as it was taken, that the pinhole camera sees too."""
        x, y = _picture_to_pinhole(self)
        inside = (x > -0.5) & (x < self.width - 0.5) & (y > -0.5) & (y < self.height - 0.5)
        return float(inside.mean())

    def to_picture(self, xy: NDArray) -> NDArray[np.float64]:
        """Pixels ``(N, 2)`` of the pinhole camera as those of the picture; NaN where the lens does not see them."""
        rays = (np.asarray(xy, np.float64) - self.pinhole[2:]) / self.pinhole[:2]
        radius = np.linalg.norm(rays, axis=1)
        seen = np.isfinite(radius) & (radius < _reach(self.model, self.coefficients))
        return np.where(seen[:, None], self._distort(np.where(seen[:, None], rays, 0.0)), np.nan)

    def to_pinhole(self, xy: NDArray) -> NDArray[np.float64]:
        """Pixels ``(N, 2)`` of the picture as those of the pinhole camera; NaN where there are none."""
        pixels = np.asarray(xy, np.float64)
        there = np.asarray(np.isfinite(pixels).all(1))
        rays = self._rays(np.where(there[:, None], pixels, self.picture[2:]))
        found = rays * self.pinhole[:2] + self.pinhole[2:]
        # The inverse is found step by step, which may end elsewhere beyond where the lens folds over.
        off = np.linalg.norm(self.to_picture(found) - pixels, axis=1)
        return np.where((there & (off < 0.1))[:, None], found, np.nan)

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture ``(H, W, 3)`` as the pinhole camera would have taken it; black where the lens saw nothing."""
        return cast("NDArray[np.uint8]", cv2.remap(image, *_pinhole_to_picture(self), cv2.INTER_LINEAR))

    def mask_to_pinhole(self, mask: NDArray) -> NDArray:
        """A mask ``(H, W)`` of the picture, bool or float32 in [0, 1], as one of the pinhole camera's."""
        return _shift(mask, _pinhole_to_picture(self))

    def mask_to_picture(self, mask: NDArray) -> NDArray:
        """A mask ``(H, W)`` of the pinhole camera's picture, as one of the picture that was taken."""
        return _shift(mask, _picture_to_pinhole(self))

    @property
    def K(self) -> NDArray[np.float64]:
        """``(3, 3)`` of the picture as it was taken."""
        fx, fy, cx, cy = self.picture
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def _distort(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        if not len(rays):
            return rays
        k = np.array(self.coefficients)
        if self.model == "fisheye":
            return cv2.fisheye.distortPoints(rays[None], self.K, k)[0]
        ahead = np.column_stack([rays, np.ones(len(rays))])[None]
        return cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), self.K, k)[0].reshape(-1, 2)

    def _rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Normalised coordinates ``(N, 2)`` of pixels of the picture."""
        if not len(pixels):
            return pixels
        if self.model == "fisheye":
            bent = (pixels - self.picture[2:]) / self.picture[:2]
            angle = np.linalg.norm(bent, axis=1)
            table = np.linspace(0.0, np.arctan(_reach(self.model, self.coefficients)), 20_000)
            theta = np.interp(angle, _fisheye(table, self.coefficients), table)
            scale = np.divide(np.tan(theta), angle, out=np.ones_like(angle), where=angle > 1e-9)
            return bent * scale[:, None]
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        K, k = self.K, np.array(self.coefficients)
        return cv2.undistortPoints(pixels[:, None], K, k, criteria=stop).reshape(-1, 2)


@lru_cache(maxsize=64)
def _reach(model: Model, coefficients: tuple[float, ...]) -> float:
    """The radius of the undistorted picture, in focal lengths, from which on the lens would fold it over."""
    if model == "fisheye":
        angles = np.linspace(0.0, np.arctan(_WIDEST), 4096)
        radius, seen = np.tan(angles), _fisheye(angles, coefficients)
    else:
        radius = np.linspace(0.0, _WIDEST, 4096)
        k1, k2, _, _, k3, k4, k5, k6, *_ = (*coefficients, *[0.0] * 8)
        q = radius**2
        below = 1 + q * (k4 + q * (k5 + q * k6))
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = radius * (1 + q * (k1 + q * (k2 + q * k3))) / below
        seen = np.where(np.minimum.accumulate(below) > 0, seen, -np.inf)
    falls = np.flatnonzero(~(np.diff(seen) > 0))
    return float(radius[falls[0]] if len(falls) else radius[-1])


def _fisheye(theta: NDArray[np.float64], coefficients: tuple[float, ...]) -> NDArray[np.float64]:
    k1, k2, k3, k4 = coefficients
    q = theta**2
    return theta * (1 + q * (k1 + q * (k2 + q * (k3 + q * k4))))


Map = tuple[NDArray[np.float32], NDArray[np.float32]]
"""``(H, W)`` columns and rows that the pixels of the one picture are found at in the other."""


@lru_cache(maxsize=2)
def _pinhole_to_picture(lens: Lens) -> Map:
    return _map(lens.to_picture, lens)


@lru_cache(maxsize=2)
def _picture_to_pinhole(lens: Lens) -> Map:
    return _map(lens.to_pinhole, lens)


def _map(way: Callable[[NDArray], NDArray[np.float64]], lens: Lens) -> Map:
    """Every `_STEP` pixels by the formula, linearly in between: lenses are smooth, and their inverse is slow."""
    rows, columns = np.mgrid[: lens.height + _STEP : _STEP, : lens.width + _STEP : _STEP]
    found = way(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    coarse = np.nan_to_num(found, nan=_NOWHERE).clip(_NOWHERE, -_NOWHERE).astype(np.float32)
    y, x = np.mgrid[: lens.height, : lens.width].astype(np.float32) / _STEP
    fine = cv2.remap(coarse.reshape(*rows.shape, 2), x, y, cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[..., 0]), np.ascontiguousarray(fine[..., 1])


def _shift(mask: NDArray, maps: Map) -> NDArray:
    soft = cv2.remap(mask.astype(np.float32), *maps, cv2.INTER_LINEAR)
    return soft >= 0.5 if mask.dtype == np.bool_ else soft.astype(mask.dtype)
