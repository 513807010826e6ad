"""What moves as the object does, of what lies beside its mask: one frame against an earlier one, while frames come.

A side that turns into view is in no mask yet, and no surface says how deep it lies. But where a pixel of the object was
in an earlier frame is known but for its depth, since the object's poses are: it lies on a line. So every pixel is asked
whether the earlier frame shows the same patch at one of a few depths around the surface's, carried on beyond the
silhouette, and whether the background's motion explains it better. What was hidden behind the object, has no
texture, or moves alike in both, says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.evidence.motion import background_motion, smaller
from tracking3d.evidence.scene import Mask, Plane, surface_in
from tracking3d.geometry.camera import Camera, Window

_DEPTHS = np.linspace(-0.4, 1.2, 9)
"""Where a pixel beside the silhouette may lie, behind the surface beside it, in radii of the object: what turns into
view lies behind the edge that it turns about."""
_LARGEST = 144  # pixels of the window's side
_MOVED = 4.0  # pixels of the small frame by which the motions part in the median, at least
_APART = (1.0, 3.0)  # such pixels of a pixel's own motions, from which on, and in full, it can be told
_PATCH = 7
_NOISE = 3.0  # grey levels
_MOST = 1.5
_TEXTURE = (8.0, 24.0)  # grey levels of contrast in a patch
_ATTEMPTS = 3
_SHIFT = 3  # pixels
_SQUARE = np.ones((3, 3), np.uint8)

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Past:
    """A frame that was believed.

    Attributes:
        index: Of the frame.
        grey: ``(h, w)`` the frame as `tracking3d.evidence.motion.small_grey` gives it.
        T_cam_obj: ``(4, 4)``.
        mask: ``(H, W)`` its answer.
    """

    index: int
    grey: NDArray[np.uint8]
    T_cam_obj: Matrix
    mask: Mask

    @classmethod
    def of(cls, index: int, grey: NDArray[np.uint8], T_cam_obj: Matrix, mask: Mask) -> Past:
        """Of a frame ``(H, W)``, grey."""
        return cls(index, smaller(grey), T_cam_obj, mask)


def moves_along(
    here: Past,
    earlier: Sequence[Past],
    window: Window,
    camera: Camera,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> Plane | None:
    """``(S, S)`` in [-1, 1] whether a window's pixels move as the object does (positive), or as the background.

    Args:
        here: The frame; its mask is where the object is known to be.
        earlier: Frames before it, in order of time.
        window: Of the frame, ``S`` pixels wide.
        camera: Of all frames.
        vertices: ``(V, 3)`` of the object.
        faces: ``(F, 3)``.

    Returns:
        None where no earlier frame can tell.
    """
    seen = Window(window.left, window.top, window.side, min(window.size, _LARGEST))
    drawn, inverse_depth = surface_in(seen.K(camera), here.T_cam_obj, vertices, faces, seen.size)
    if not earlier or not drawn.any():
        return None
    ways = _ways_apart(here, earlier, seen, camera, inverse_depth, drawn)
    if ways is None:
        return None
    middle = vertices.mean(0)
    radius = float(np.linalg.norm(vertices - middle, axis=1).max())
    told = _told(_grey(here, seen), ways, inverse_depth, radius)
    return cv2.resize(told, (window.size, window.size), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True, eq=False)
class _Ways:
    """How a window's pixels get into an earlier frame, in the pixels of its `small_grey`.

    Attributes:
        past: The earlier frame.
        turned: ``(S, S, 3)`` homogeneous, by the object's motion, of what is infinitely far.
        shift: ``(3,)`` that is added to it for each inverse depth.
        background: ``(S, S, 2)``.
    """

    past: Past
    turned: Matrix
    shift: Matrix
    background: NDArray[np.float32]

    @classmethod
    def of(cls, here: Past, past: Past, window: Window, camera: Camera) -> _Ways | None:
        """None where the background's motion is not known."""
        H = background_motion(here.grey, past.grey, here.mask)
        if H is None:
            return None
        T = past.T_cam_obj @ np.linalg.inv(here.T_cam_obj)
        to_small = _to_small(past)
        homogeneous = _homogeneous(window.size)
        turned = homogeneous @ (to_small @ camera.K @ T[:3, :3] @ np.linalg.inv(window.K(camera))).T
        beyond = homogeneous @ (to_small @ H @ _to_frame(window)).T
        return cls(past, turned, to_small @ camera.K @ T[:3, 3], _projected(beyond))

    def of_object(self, inverse_depth: Matrix) -> NDArray[np.float32]:
        """``(S, S, 2)`` by the object's motion, of points at one over a depth ``(S, S)``."""
        return _projected(self.turned + inverse_depth[..., None] * self.shift)


def _ways_apart(
    here: Past, earlier: Sequence[Past], window: Window, camera: Camera, inverse_depth: Plane, drawn: Mask
) -> _Ways | None:
    """Into the latest earlier frame that the two motions part in by enough; None where there is none.

    How far they part in the frame before says how many frames it takes.
    """
    lag, most = 1, len(earlier)
    for _ in range(_ATTEMPTS):
        ways = _Ways.of(here, earlier[-lag], window, camera)
        if ways is None:
            return None
        parted = np.linalg.norm(ways.of_object(inverse_depth)[drawn] - ways.background[drawn], axis=-1)
        middle = float(np.median(parted))
        if middle >= _MOVED:
            return ways
        wanted = int(np.ceil(lag * _MOVED / max(middle, 1e-3)))
        if lag == most or wanted > 2 * most:
            return None
        lag = min(max(wanted, lag + 1), most)
    return None


def _told(
    grey: NDArray[np.uint8], ways: _Ways, inverse_depth: Plane, radius: float
) -> Plane:
    """``(S, S)`` see `moves_along`."""
    depth = 1 / np.maximum(inverse_depth.astype(np.float64), 1e-9)
    ours = np.full(grey.shape, np.inf, np.float32)
    told = np.zeros(grey.shape, np.float32)
    for offset in _DEPTHS * radius:
        way = ways.of_object(1 / np.maximum(depth + offset, 1e-9))
        parted = np.linalg.norm(way - ways.background, axis=-1)
        share = np.clip((parted - _APART[0]) / (_APART[1] - _APART[0]), 0, 1)
        cost = np.where(share > 0, _residual(grey, ways.past.grey, way), np.inf)
        told = np.where(cost < ours, share, told)
        ours = np.minimum(ours, cost)
    theirs = _residual(grey, ways.past.grey, ways.background)
    covered = cv2.remap(
        _small_mask(ways.past), ways.background, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
    )
    # Behind the object nobody saw the background: there the patch has to be one that fits nowhere else.
    theirs = np.where(covered > 0, np.minimum(theirs, _distinct(grey)), theirs)
    known = np.isfinite(ours)
    cue = np.clip(np.log((theirs + _NOISE) / (np.where(known, ours, 0) + _NOISE)) / _MOST, -1, 1)
    cue = np.where(covered > 0, np.maximum(cue, 0), cue)
    return (cue * told * known * _texture(grey)).astype(np.float32)


def _distinct(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """``(S, S)`` by how much a patch differs at least from what lies a few pixels beside it (Moravec)."""
    least = np.full(grey.shape, np.inf, np.float32)
    for right, down in ((_SHIFT, 0), (0, _SHIFT), (_SHIFT, _SHIFT), (_SHIFT, -_SHIFT)):
        moved = np.roll(grey, (down, right), (0, 1))
        beyond = cv2.absdiff(grey, moved).astype(np.float32)
        least = np.minimum(least, cv2.blur(beyond, (_PATCH, _PATCH)))
    return least


def _residual(
    grey: NDArray[np.uint8], there: NDArray[np.uint8], way: NDArray[np.float32]
) -> NDArray[np.float32]:
    """``(S, S)`` grey levels by which patches differ; a value between those of a pixel's neighbours does not."""
    seen = cv2.remap(there, way, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    beyond = cv2.add(
        cv2.subtract(grey, cv2.dilate(seen, _SQUARE)), cv2.subtract(cv2.erode(seen, _SQUARE), grey)
    )
    return cv2.blur(beyond.astype(np.float32), (_PATCH, _PATCH))


def _texture(grey: NDArray[np.uint8]) -> Plane:
    """``(S, S)`` in [0, 1]: what is even moves with anything."""
    contrast = cv2.subtract(cv2.dilate(grey, _SQUARE), cv2.erode(grey, _SQUARE)).astype(np.float32)
    around = cv2.blur(contrast, (_PATCH, _PATCH))
    return np.clip((around - _TEXTURE[0]) / (_TEXTURE[1] - _TEXTURE[0]), 0, 1)


def _grey(here: Past, window: Window) -> NDArray[np.uint8]:
    """``(S, S)`` what the window shows of a frame."""
    way = _projected(_homogeneous(window.size) @ (_to_small(here) @ _to_frame(window)).T)
    return cv2.remap(here.grey, way, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _small_mask(past: Past) -> NDArray[np.uint8]:
    height, width = past.grey.shape
    return cv2.resize(past.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)


def _to_small(past: Past) -> Matrix:
    """``(3, 3)`` from the frame's pixels to those of its `small_grey`; centres are at integers in both."""
    to_small = np.diag([past.grey.shape[1] / past.mask.shape[1], past.grey.shape[0] / past.mask.shape[0], 1.0])
    to_small[:2, 2] = (to_small[[0, 1], [0, 1]] - 1) / 2
    return to_small


def _to_frame(window: Window) -> Matrix:
    """``(3, 3)`` from the window's pixels to the frame's."""
    to_frame = np.diag([1 / window.scale, 1 / window.scale, 1.0])
    to_frame[:2, 2] = tuple(0.5 / window.scale + edge - 0.5 for edge in (window.left, window.top))
    return to_frame


def _homogeneous(size: int) -> Matrix:
    """``(S, S, 3)`` the window's pixels."""
    at = np.arange(float(size))
    u, v = np.meshgrid(at, at)
    return np.stack([u, v, np.ones_like(u)], -1)


def _projected(points: Matrix) -> NDArray[np.float32]:
    ahead = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    return np.nan_to_num(points[..., :2] / ahead, nan=-1e4).astype(np.float32)
