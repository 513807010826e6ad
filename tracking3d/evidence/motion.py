"""Which of two motions explains another frame: the object's, which is known in space, or the background's.

The object's is that of its pose and surface, carried on beyond the silhouette; the background's is a homography fitted
outside the masks. Where both go to the same place, or nothing has texture, there is no answer. A shadow lies on the
road, whose texture stays; a side that comes into view moves with the object.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.evidence.scene import Mask, Plane, Scene
from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera

_CORNERS, _LEAST_CORNERS = 300, 12
_AGREEING = 0.3  # of the corners
_LARGEST = 480  # pixels of the longer side of the frames in which the background is followed
_APART = (1.0, 3.0)
"""Frame pixels by which the motions part from which on, and in full, they can be told."""
_PATCH = 5
_NOISE = 3.0  # grey levels
_FINE = 4.0  # pixels: a shadow's edge is coarser
_MOST = 2.0
_TEXTURE = (4.0, 20.0)
"""Mean contrast of neighbouring pixels in a patch, grey levels, from which on, and in full, its motion can be told."""

Matrix = NDArray[np.float64]
Target = tuple[Image, Matrix, Matrix]
"""Another frame ``(H, W, 3)``, the object's pose ``(4, 4)`` there, and the background's homography ``(3, 3)`` to it."""


def small_grey(image: Image) -> NDArray[np.uint8]:
    """The frame as the background is followed in it."""
    factor = min(1.0, _LARGEST / max(image.shape[:2]))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def background_motion(
    here: NDArray[np.uint8], there: NDArray[np.uint8], object_here: Mask
) -> NDArray[np.float64] | None:
    """``(3, 3)`` homography from a frame's pixels to those of the next, outside the object; None where none fits.

    Args:
        here: From `small_grey`.
        there: Likewise, of the other.
        object_here: ``(H, W)`` of the full frame.
    """
    height, width = here.shape
    hidden = cv2.resize(object_here.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    free = 1 - cv2.dilate(hidden, np.ones((9, 9), np.uint8))
    corners = cv2.goodFeaturesToTrack(here, _CORNERS, 0.01, 6, mask=free)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(here, there, corners, None)
    kept = found.ravel() > 0
    if np.count_nonzero(kept) < _LEAST_CORNERS:
        return None
    H, agreeing = cv2.findHomography(corners[kept], moved[kept], cv2.RANSAC, 1.5)
    if H is None or np.count_nonzero(agreeing) < max(_LEAST_CORNERS, _AGREEING * np.count_nonzero(kept)):
        return None
    to_small = np.diag([width / object_here.shape[1], height / object_here.shape[0], 1.0])
    to_small[:2, 2] = (to_small[[0, 1], [0, 1]] - 1) / 2  # pixel centres are at integers in both
    return np.asarray(np.linalg.inv(to_small) @ H @ to_small)


def apart(scene: Scene, camera: Camera, target: Target) -> float:
    """Median of the frame pixels by which the two motions part in the answer; 0 where it cannot be told."""
    step = max(scene.window.size // 24, 1)
    parted = np.linalg.norm(
        _object_flow(scene, camera, target[1], step) - _background_flow(scene, target[2], step), axis=-1
    )
    parted = parted[scene.answer[::step, ::step] & np.isfinite(parted)]
    return float(np.median(parted)) if parted.size else 0.0


def motion_cue(scene: Scene, camera: Camera, targets: Sequence[Target]) -> NDArray[np.float32]:
    """``(2, S, S)`` log of how badly the background's motion explains a pixel over how badly the object's does.

    Args:
        scene: The frame.
        camera: Of all frames.
        targets: Frames before and after it; what one hides another may show.

    Returns:
        By colours and by fine texture, within 2; 0 where the motions cannot be told.
    """
    size = scene.window.size
    costs = np.full((2, 2, size, size), np.inf, np.float32)  # by colours and fine; object and background
    told = np.zeros((size, size), np.float32)
    here = _both(scene.image)
    for image, T_cam_obj, H in targets:
        ways = _object_flow(scene, camera, T_cam_obj), _background_flow(scene, H)
        parted = np.nan_to_num(np.linalg.norm(ways[0] - ways[1], axis=-1))
        share = np.clip((parted - _APART[0]) / (_APART[1] - _APART[0]), 0, 1)
        if not share.any():
            continue
        found = np.stack([_residuals(here, image, at) for at in ways], 1)
        known = np.isfinite(found).all((0, 1)) & (share > 0)
        costs = np.where(known, np.fmin(costs, found), costs)
        told = np.where(known, np.maximum(told, share), told)
    known = np.isfinite(costs).all((0, 1))
    costs = np.where(known, costs, 0)
    cue = np.log((costs[:, 1] + _NOISE) / (costs[:, 0] + _NOISE))
    return np.asarray(told * _texture(scene.image) * np.clip(cue, -_MOST, _MOST), np.float32)


def _object_flow(scene: Scene, camera: Camera, T_cam_obj: Matrix, step: int = 1) -> NDArray[np.float32]:
    """``(S, S, 2)`` where in the other frame a pixel's surface point is; NaN where there is none."""
    size = scene.window.size
    v, u = np.mgrid[:size:step, :size:step].astype(np.float32)
    inverse_depth = scene.inverse_depth[::step, ::step, None]
    T = T_cam_obj @ np.linalg.inv(scene.T_cam_obj)
    through = (camera.K @ T[:3, :3] @ np.linalg.inv(scene.K)).astype(np.float32)
    moved = np.stack([u, v, np.ones_like(u)], -1) @ through.T
    moved += inverse_depth * (camera.K @ T[:3, 3]).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where((inverse_depth > 0) & (moved[..., 2:] > 0), moved[..., 2:], np.nan)
        return np.asarray(moved[..., :2] / ahead, np.float32)


def _background_flow(scene: Scene, H: Matrix, step: int = 1) -> NDArray[np.float32]:
    """``(S, S, 2)`` where in the other frame a pixel of the background is."""
    window = scene.window
    v, u = np.mgrid[: window.size : step, : window.size : step].astype(np.float32)
    x, y = ((at + 0.5) / window.scale + edge - 0.5 for at, edge in ((u, window.left), (v, window.top)))
    moved = np.stack([x, y, np.ones_like(x)], -1) @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(moved[..., :2] / np.where(moved[..., 2:] > 0, moved[..., 2:], np.nan), np.float32)


def _residuals(here: list[NDArray[np.float32]], image: Image, at: NDArray[np.float32]) -> Plane:
    """``(2, S, S)`` grey levels by which patches differ from those of another frame, by colours and by fine texture.

    A value between those of a pixel's neighbours does not differ: poses are off by a pixel.
    """
    limit = np.array([image.shape[1] - 1, image.shape[0] - 1])
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((at > 0) & (at < limit)).all(-1))
    at = np.where(inside[..., None], at, 0).astype(np.float32)
    there = _both(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR))
    square, found = np.ones((3, 3), np.uint8), []
    for mine, other in zip(here, there, strict=True):
        beyond = np.maximum(mine - cv2.dilate(other, square), cv2.erode(other, square) - mine)
        found.append(cv2.blur(np.maximum(beyond, 0).mean(-1), (_PATCH, _PATCH)))
    return np.where(inside, np.stack(found), np.nan).astype(np.float32)


def _both(image: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
    """An image as it is, and what is finer than a shadow."""
    plain = image.astype(np.float32)
    return [plain, plain - cv2.GaussianBlur(plain, (0, 0), _FINE)]


def _texture(image: NDArray[np.uint8]) -> Plane:
    """``(S, S)`` in [0, 1]: what is even moves with anything."""
    square = np.ones((3, 3), np.uint8)
    contrast = cv2.dilate(image, square).astype(np.float32) - cv2.erode(image, square)
    around = cv2.blur(contrast.mean(-1), (_PATCH, _PATCH))
    return np.asarray(np.clip((around - _TEXTURE[0]) / (_TEXTURE[1] - _TEXTURE[0]), 0, 1), np.float32)
