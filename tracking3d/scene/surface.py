"""The surface of the object drawn into a view of it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.rendering.visibility import nearest_depth
from tracking3d.scene.view import Array, Mask, ObjectView, Plane, project_points

_MOST_AT_ONCE = 2**14  # pixels that OpenCV looks up in one call


@dataclass(frozen=True, eq=False, kw_only=True)
class Drawn(ObjectView):
    """A view with the surface in it, drawn by `draw`."""

    # (h, w) float32, one over the depth of the surface, carried on beyond the outline with the depth of the
    # nearest drawn pixel; 0 further off
    inverse_depth: Plane
    beyond: Plane  # (h, w) float32 pixels to the nearest drawn one; 0 on the surface

    @cached_property
    def silhouette(self) -> Mask:
        """``(h, w)`` where the surface is, as far as the frame goes."""
        return (self.beyond == 0) & self.in_frame

    def surface(self, xy: Array) -> Array:
        """The object points ``(N, 3)`` under pixels ``(N, 2)``; NaN where it is not carried on."""
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

    @cached_property
    def _deepest_around(self) -> Plane:  # on a steep surface a pixel aside is much nearer or further
        return cv2.erode(self.inverse_depth, np.ones((3, 3), np.uint8))

    def sees(self, points: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """Where object points are, and which of them the surface does not hide and the window holds.

        Args:
            points: ``(N, 3)``.
            tolerance: How far behind the drawn surface a point may lie and be seen, in object units.

        Returns:
            ``(N, 2)`` pixels and ``(N,)`` bool.
        """
        xy, depth = self.project(points)
        height, width = self.window.shape
        with np.errstate(invalid="ignore"):
            inside = ((xy > -0.5) & (xy < (width - 0.5, height - 0.5))).all(1)
        drawn = sample(self._deepest_around, xy).astype(np.float64)
        near = inside & (drawn > 0) & (sample(self.beyond, xy) < 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            return xy, near & (depth < 1 / drawn + tolerance)


def camera_tensors(view: ObjectView) -> tuple[Tensor, Tensor, Tensor]:
    """``(1, 3, 3)`` rotation, ``(1, 3)`` translation and ``(1, 3, 3)`` intrinsics of a view, float32."""
    T = torch.from_numpy(view.T_cam_obj[None]).float()
    return T[:, :3, :3], T[:, :3, 3], torch.from_numpy(view.K[None]).float()


def image_tensor(view: ObjectView) -> Tensor:
    """``(3, h, w)`` colours of a view in [0, 1]."""
    return torch.from_numpy(view.image).permute(2, 0, 1).float() / 255


def draw(view: ObjectView, vertices: Array, faces: NDArray[np.int64], reach: float = np.inf) -> Drawn:
    """The view with a surface drawn into it.

    Args:
        view: The view; what was drawn into it before is not kept.
        vertices: ``(V, 3)`` in object coordinates.
        faces: ``(F, 3)``.
        reach: Pixels beyond the outline up to which the surface is carried on.
    """
    drawn = draw_depth(view.K, view.T_cam_obj, vertices, faces, view.window.shape, reach)
    same = {one.name: getattr(view, one.name) for one in fields(ObjectView)}
    return Drawn(**same, inverse_depth=drawn[0], beyond=drawn[1])


def draw_depth(
    K: Array,
    T_cam_obj: Array,
    vertices: Array,
    faces: NDArray[np.int64],
    size: tuple[int, int],
    reach: float = np.inf,
) -> tuple[Plane, Plane]:
    """`Drawn.inverse_depth` and `Drawn.beyond` of ``size`` ``(h, w)``, of a surface that a camera ``(3, 3)`` sees.

    Without a pose, or where nothing is seen of the surface, the first is 0 and the second more than any distance.
    """
    screen, depth = project_points(vertices, K, T_cam_obj)
    drawn = nearest_depth(
        torch.from_numpy(np.nan_to_num(screen, nan=-1e6).astype(np.float32)),
        torch.from_numpy(depth.astype(np.float32)),
        torch.tensor(faces),
        size,
    ).numpy()
    covered = np.asarray(np.isfinite(drawn))
    if not covered.any():
        return np.zeros(size, np.float32), np.full(size, sum(size), np.float32)
    beyond, nearest = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Labels number the drawn pixels; which is which is read where they are.
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[covered]] = 1 / drawn[covered]
    inverse = np.where(beyond < reach, by_label[nearest], 0).astype(np.float32)
    return inverse, beyond.astype(np.float32)


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
