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

from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import Mask, Plane

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

_SQUARE = np.ones((3, 3), np.uint8)
_THIRDS = np.full((1, 3), 1 / 3)

_Both = tuple[NDArray[np.uint8], NDArray[np.float32]]
Matrix = NDArray[np.float64]
Target = tuple[Image, Matrix, Matrix]
"""Another frame ``(H, W, 3)``, the object's pose ``(4, 4)`` there, and the background's homography ``(3, 3)`` to it."""


def small_grey(image: Image) -> NDArray[np.uint8]:
    """The frame as the background is followed in it."""
    return smaller(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def smaller(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same of a frame that is grey already."""
    factor = min(1.0, _LARGEST / max(grey.shape))
    return grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def background_motion(
    here: NDArray[np.uint8], there: NDArray[np.uint8], object_here: Mask
) -> NDArray[np.float64] | None:
    """``(3, 3)`` homography from a frame's pixels to those of the next, outside the object; None if none fits.

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


def flow_distance(scene: Drawn, camera: Camera, target: Target) -> float:
    """Median of the frame pixels by which the two motions part in the answer; 0 if it cannot be told."""
    step = max(scene.window.size // 24, 1)
    parted = np.linalg.norm(
        _object_flow(scene, camera, target[1], step) - _background_flow(scene, target[2], step), axis=-1
    )
    parted = parted[scene.mask[::step, ::step] & np.isfinite(parted)]
    return float(np.median(parted)) if parted.size else 0.0


def motion_cue(scene: Drawn, camera: Camera, targets: Sequence[Target]) -> NDArray[np.float32]:
    """``(2, S, S)`` log of how badly the background's motion explains a pixel over how badly the object's does.

    Args:
        scene: The frame.
        camera: The camera of all frames.
        targets: Frames before and after it; what one hides another may show.

    Returns:
        By colours and by fine texture, within 2; 0 if the motions cannot be told.
    """
    size = scene.window.size
    costs = np.full((2, 2, size, size), np.inf, np.float32)  # of object and background; by colours and fine
    told = np.zeros((size, size), np.float32)
    here = _both(scene.image)
    for target in targets:
        ways, share = _motion_parallax(scene, camera, target)
        known = share > 0
        if not known.any():
            continue
        for cost, at in zip(costs, ways, strict=True):
            found = _residuals(here, _both(cv2.remap(target[0], at, None, cv2.INTER_LINEAR)))
            np.minimum(cost, np.where(known, found, np.inf), out=cost)
        np.maximum(told, share, out=told)
    known = told > 0
    ours, theirs = np.where(known, costs, 0) + np.float32(_NOISE)
    cue = np.clip(np.log(theirs / ours), -_MOST, _MOST)
    return np.asarray(told * _texture(scene.image) * cue, np.float32)


def _motion_parallax(
    scene: Drawn, camera: Camera, target: Target
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where pixels are in another frame.

    Returns:
        ``(2, S, S, 2)`` by the object's motion and by the background's, and ``(S, S)`` in [0, 1] how far that can be
        told apart; both 0 if either leads out of the frame.
    """
    image, T_cam_obj, H = target
    of_surface = np.column_stack(_through(scene, camera, T_cam_obj))
    return motion_parallax(
        scene.inverse_depth, of_surface, H @ scene.window.to_frame, image.shape[:2], _APART
    )


def motion_parallax(
    inverse_depth: Plane,
    of_surface: Matrix,
    of_background: Matrix,
    image_size: tuple[int, int],
    apart: tuple[float, float],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where pixels are in another frame.

    Args:
        inverse_depth: ``(S, S)``, 0 if there is none.
        of_surface: ``(3, 4)`` from ``u, v, 1, 1 / depth`` to homogeneous pixels of the other frame.
        of_background: ``(3, 3)`` from ``u, v, 1`` to those.
        image_size: ``(H, W)`` of the other frame.
        apart: Pixels of distance from which on, and in full, the motions can be told.

    Returns:
        See `_motion_parallax`.
    """
    from tracking3d.estimation.segmentation.kernels import motion_cue

    return motion_cue.motion_parallax(
        inverse_depth, of_surface, np.ascontiguousarray(of_background), image_size, apart
    )


def _through(scene: Drawn, camera: Camera, T_cam_obj: Matrix) -> tuple[Matrix, Matrix]:
    """``(3, 3)`` and ``(3,)`` that take the window's ``u, v, 1`` and one over a depth to the other frame's pixels."""
    T = T_cam_obj @ np.linalg.inv(scene.T_cam_obj)
    return camera.K @ T[:3, :3] @ np.linalg.inv(scene.K), camera.K @ T[:3, 3]


def _object_flow(scene: Drawn, camera: Camera, T_cam_obj: Matrix, step: int = 1) -> NDArray[np.float32]:
    """``(S, S, 2)`` where in the other frame a pixel's surface point is; NaN if there is none."""
    inverse_depth = scene.inverse_depth[::step, ::step, None]
    through, shift = _through(scene, camera, T_cam_obj)
    moved = _carry_through(scene.window.size, through, step) + inverse_depth * shift
    return _project(np.where(inverse_depth > 0, moved, np.nan))


def _background_flow(scene: Drawn, H: Matrix, step: int = 1) -> NDArray[np.float32]:
    """``(S, S, 2)`` where in the other frame a pixel of the background is."""
    return _project(_carry_through(scene.window.size, H @ scene.window.to_frame, step))


def _carry_through(size: int, through: Matrix, step: int = 1) -> Matrix:
    """``(S, S, 3)`` where a matrix ``(3, 3)`` takes every n-th of a window's pixels, homogeneous."""
    at = np.arange(0.0, size, step)
    by_u, by_v, first = through.T
    return np.asarray(at[:, None] * by_u + at[:, None, None] * by_v + first)


def _project(points: Matrix) -> NDArray[np.float32]:
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        return np.asarray(points[..., :2] / ahead, np.float32)


def _residuals(here: _Both, there: _Both) -> NDArray[np.float32]:
    """``(2, S, S)`` grey levels by which patches differ from those of another frame, by colours and by fine texture.

    A value between those of a pixel's neighbours does not differ: poses are off by a pixel.
    """
    # Bytes end at 0 by themselves.
    beyond = cv2.add(
        cv2.subtract(here[0], cv2.dilate(there[0], _SQUARE)),
        cv2.subtract(cv2.erode(there[0], _SQUARE), here[0]),
    )
    fine = cv2.max(here[1] - cv2.dilate(there[1], _SQUARE), cv2.erode(there[1], _SQUARE) - here[1])
    means = _mean(beyond.astype(np.float32)), _mean(cv2.max(fine, 0.0))
    return np.stack([cv2.blur(one, (_PATCH, _PATCH)) for one in means])


def _both(image: NDArray[np.uint8]) -> _Both:
    """An image as it is, and what is finer than a shadow."""
    plain = image.astype(np.float32)
    return image, plain - cv2.GaussianBlur(plain, (0, 0), _FINE)


def _texture(image: NDArray[np.uint8]) -> Plane:
    """``(S, S)`` in [0, 1]: what is even moves with anything."""
    contrast = cv2.subtract(cv2.dilate(image, _SQUARE), cv2.erode(image, _SQUARE))
    around = cv2.blur(_mean(contrast.astype(np.float32)), (_PATCH, _PATCH))
    return np.asarray(np.clip((around - _TEXTURE[0]) / (_TEXTURE[1] - _TEXTURE[0]), 0, 1), np.float32)


def _mean(image: NDArray[np.float32]) -> Plane:
    """``(S, S)`` of the three channels."""
    return cv2.transform(image, _THIRDS)
