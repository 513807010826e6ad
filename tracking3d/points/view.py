"""One frame prepared for point tracking: a window of the image around the object, with the mesh rendered into it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera
from tracking3d.rendering.visibility import NEAR, rasterize

Array = NDArray[np.float64]
Plane = NDArray[np.float32]

LONGEST_SIDE = 320
"""Pixels of a window, where nothing else is said."""
LANDMARK_WINDOW = 240
"""Pixels of the windows in which landmarks are followed that adjust a map or a whole video."""
MARGIN = 12
"""Frame pixels around mask and mesh that belong to the window."""
REACH = 12.0
"""Window pixels beyond the drawn outline up to which the surface is carried on."""
_MOST_AT_ONCE = 2**14  # pixels that OpenCV looks up in one call


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """A window of a frame and the surface in it. All pixels are the window's own; see `to_window`."""

    image: Plane  # (h, w) float32 grey values
    mask: Plane  # (h, w) float32, 1 on the object
    corner: tuple[int, int]  # left and upper edge of the window in the frame
    scale: Array  # (2,) window pixels per frame pixel
    intrinsics: Array  # (4,) fx, fy, cx, cy of the window
    T_cam_obj: Array  # (4, 4)
    # (h, w) float32, one over the depth of the surface, carried on beyond the outline with the depth of the
    # nearest drawn pixel; 0 further off
    inverse_depth: Plane
    beyond: Plane  # (h, w) float32 pixels to the nearest drawn one; 0 on the surface

    def to_window(self, xy: Array) -> Array:
        """Pixels ``(..., 2)`` of the frame as pixels of the window."""
        return (xy + 0.5 - np.array(self.corner)) * self.scale - 0.5

    def to_frame(self, xy: Array) -> Array:
        """Pixels ``(..., 2)`` of the window as pixels of the frame."""
        return (xy + 0.5) / self.scale - 0.5 + np.array(self.corner)

    def intrinsics_of(self, camera: Camera) -> Array:
        """``(4,)`` fx, fy, cx, cy of a camera of the frame in this window."""
        focal = np.array([camera.fx, camera.fy]) * self.scale
        return np.concatenate([focal, self.to_window(np.array([camera.cx, camera.cy]))])

    def project(self, points: Array) -> tuple[Array, Array]:
        """Object points ``(N, 3)`` as ``(N, 2)`` pixels, NaN behind the camera, and ``(N,)`` depths."""
        seen = points @ self.T_cam_obj[:3, :3].T + self.T_cam_obj[:3, 3]
        depth = seen[:, 2]
        with np.errstate(invalid="ignore"):
            ahead = np.where(depth > NEAR, depth, np.nan)
        fx, fy, cx, cy = self.intrinsics
        return np.stack([fx * seen[:, 0] / ahead + cx, fy * seen[:, 1] / ahead + cy], 1), depth

    def back_project(self, xy: Array, inverse_depth: NDArray[np.floating]) -> Array:
        """Pixels ``(N, 2)`` at one over their depths ``(N,)`` as object points ``(N, 3)``; NaN if that is 0."""
        depth = 1 / np.where(inverse_depth > 0, inverse_depth, np.nan).astype(np.float64)
        fx, fy, cx, cy = self.intrinsics
        seen = np.stack([(xy[:, 0] - cx) / fx * depth, (xy[:, 1] - cy) / fy * depth, depth], 1)
        points: Array = (seen - self.T_cam_obj[:3, 3]) @ self.T_cam_obj[:3, :3]
        return points

    def surface(self, xy: Array) -> Array:
        """The object points ``(N, 3)`` under pixels ``(N, 2)``; NaN further beyond the outline than `REACH`."""
        return self.back_project(xy, sample(self.inverse_depth, xy))

    def slant(self, xy: Array) -> Array:
        """``(N,)`` cosines between the rays of pixels ``(N, 2)`` and the surface; 0 beyond the outline."""
        here = self.surface(xy)
        across = [self.surface(xy + step) - here for step in ((0.5, 0.0), (0.0, 0.5))]
        normal = np.cross(across[0], across[1])
        ray = here + self.T_cam_obj[:3, :3].T @ self.T_cam_obj[:3, 3]
        length = np.linalg.norm(normal, axis=1) * np.linalg.norm(ray, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = np.abs((normal * ray).sum(1)) / length
        return np.where(np.isfinite(cosine) & (sample(self.beyond, xy) < 0.5), cosine, 0.0)

    def sees(self, points: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """Where object points are, and which of them the surface does not hide and the window holds.

        Args:
            points: ``(N, 3)``.
            tolerance: How far behind the drawn surface a point may lie and be seen, in object units.

        Returns:
            ``(N, 2)`` pixels and ``(N,)`` bool.
        """
        xy, depth = self.project(points)
        height, width = self.image.shape
        with np.errstate(invalid="ignore"):
            inside = ((xy > -0.5) & (xy < (width - 0.5, height - 0.5))).all(1)
        # The deepest around: on a steep surface a pixel aside is much nearer or further.
        around = cv2.erode(self.inverse_depth, np.ones((3, 3), np.uint8))
        drawn = sample(around, xy).astype(np.float64)
        near = inside & (drawn > 0) & (sample(self.beyond, xy) < 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            return xy, near & (depth < 1 / drawn + tolerance)


def sample(plane: Plane, xy: Array) -> Plane:
    """``(N,)`` values of ``(h, w)`` between pixels; 0 if a pixel is not finite."""
    finite = np.asarray(np.isfinite(xy).all(1))
    at = np.where(finite[:, None], xy, 0).astype(np.float32)
    if not len(at):
        return np.zeros(0, np.float32)
    values = np.concatenate(
        [
            cv2.remap(plane, x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
            for x, y in (at[first : first + _MOST_AT_ONCE].T for first in range(0, len(at), _MOST_AT_ONCE))
        ]
    )
    return np.where(finite, values, 0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class GreyWindow:
    """A window of a frame around the object, into which no surface is drawn yet."""

    image: NDArray[np.uint8]  # (h, w) uint8 grey values
    mask: NDArray[np.uint8]  # (h, w) uint8, 255 on the object
    corner: tuple[int, int]  # left and upper edge of the window in the frame
    scale: Array  # (2,) window pixels per frame pixel


def cut_window(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    camera: Camera,
    T_cam_obj: Array,
    vertices: Array,
    longest_side: int = LONGEST_SIDE,
) -> GreyWindow | None:
    """The window of a frame around its mask and the projected mesh.

    Args:
        image: ``(H, W, 3)`` RGB.
        mask: ``(H, W)``.
        camera: The camera of the frame.
        T_cam_obj: ``(4, 4)``.
        vertices: ``(V, 3)``.
        longest_side: Pixels of the window; a larger one is scaled down.

    Returns:
        The window, or None if the pose is no number or nothing of the object lies in the frame.
    """
    if not np.isfinite(T_cam_obj).all():
        return None
    whole = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    seen = vertices @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    if (seen[:, 2] <= NEAR).any():
        return None
    xy = seen[:, :2] / seen[:, 2:] * whole[:2] + whole[2:]
    size = np.array([camera.width, camera.height])
    pixels = np.concatenate([xy, _corners_of(mask)])
    low = np.clip(np.floor(pixels.min(0)) - MARGIN, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + MARGIN + 1, 0, size).astype(int)
    if (high - low < 8).any():
        return None
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    grey = cv2.cvtColor(image[top:bottom, left:right], cv2.COLOR_RGB2GRAY)
    inside = mask[top:bottom, left:right].astype(np.uint8) * np.uint8(255)
    factor = min(1.0, longest_side / max(grey.shape))
    width, height = (max(round(side * factor), 8) for side in (right - left, bottom - top))
    if factor < 1:
        grey, inside = (cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA) for p in (grey, inside))
    scale = np.array([width / (right - left), height / (bottom - top)])
    return GreyWindow(np.asarray(grey, np.uint8), inside, (left, top), scale)


def _corners_of(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """``(2, 2)`` the first and the last column and row of a mask; ``(0, 2)`` of an empty one."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    if not width:
        return np.zeros((0, 2), np.int64)
    return np.array([[left, top], [left + width - 1, top + height - 1]])


def draw_into_window(
    window: GreyWindow, camera: Camera, T_cam_obj: Array, vertices: Array, faces: NDArray[np.int64]
) -> SurfaceView:
    """A window with the mesh drawn into it.

    Args:
        window: The window.
        camera: The camera of the frame.
        T_cam_obj: ``(4, 4)``.
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
    """
    centre = (np.array([camera.cx, camera.cy]) + 0.5 - np.array(window.corner)) * window.scale - 0.5
    focal = np.array([camera.fx, camera.fy]) * window.scale
    image = cv2.GaussianBlur(window.image.astype(np.float32), (0, 0), 0.5)
    empty = np.zeros(image.shape, np.float32)
    view = SurfaceView(
        image, window.mask.astype(np.float32) / np.float32(255), window.corner, window.scale,
        np.concatenate([focal, centre]), T_cam_obj, empty, empty,
    )  # fmt: skip
    return redraw_surface(view, vertices, faces, T_cam_obj)


def open_view(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    camera: Camera,
    T_cam_obj: Array,
    vertices: Array,
    faces: NDArray[np.int64],
    longest_side: int = LONGEST_SIDE,
) -> SurfaceView | None:
    """The window of a frame around its mask and the projected mesh, with the mesh drawn into it.

    Args:
        image: ``(H, W, 3)`` RGB.
        mask: ``(H, W)``.
        camera: The camera of the frame.
        T_cam_obj: ``(4, 4)``.
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        longest_side: Pixels of the window; a larger one is scaled down.

    Returns:
        The view, or None if the pose is no number or nothing of the object lies in the frame.
    """
    window = cut_window(image, mask, camera, T_cam_obj, vertices, longest_side)
    return None if window is None else draw_into_window(window, camera, T_cam_obj, vertices, faces)


def redraw_surface(
    view: SurfaceView, vertices: Array, faces: NDArray[np.int64], T_cam_obj: Array
) -> SurfaceView:
    """The view with the mesh drawn into it at another pose."""
    view = replace(view, T_cam_obj=T_cam_obj)
    screen, depth = view.project(vertices)
    height, width = view.image.shape
    drawn = rasterize(
        torch.tensor(np.nan_to_num(screen, nan=-1e6), dtype=torch.float32)[None],
        torch.tensor(depth, dtype=torch.float32)[None],
        torch.tensor(faces),
        (height, width),
    ).depth[0].numpy()  # fmt: skip
    covered = np.asarray(np.isfinite(drawn))
    if not covered.any():
        nothing = np.zeros((height, width), np.float32)
        return replace(view, inverse_depth=nothing, beyond=nothing + np.float32(height + width))
    beyond, nearest = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Labels number the drawn pixels; which is which is read where they are.
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[covered]] = 1 / drawn[covered]
    inverse = np.where(beyond < REACH, by_label[nearest], 0).astype(np.float32)
    return replace(view, inverse_depth=inverse, beyond=beyond.astype(np.float32))
