"""What the kernel of `tracking3d.rendering.pose_terms` takes: object, frame and points as named tuples of arrays."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numba import boolean, float32, float64, int64
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, array, check_corners, record
from tracking3d.rendering.pose_terms import MatchedPoints, PoseTarget
from tracking3d.rendering.surface import Surface


class SurfaceArrays(NamedTuple):
    """An object as `tracking3d.rendering.surface.Surface` has it."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]
    face_uvs: NDArray[np.float32]
    edges: NDArray[np.int64]
    faces_of_edge: NDArray[np.int64]
    layers: NDArray[np.float32]


class TargetArrays(NamedTuple):
    """A frame as `PoseTarget` has it, features ``(S, S, C)``; what it does not have is empty."""

    features: NDArray[np.float32]
    comparable: NDArray[np.float32]
    inside: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    distance: NDArray[np.float32]
    K: NDArray[np.float32]


class MatchArrays(NamedTuple):
    """Points ``(N, 3)`` and where they were found ``(N, 2)``; empty if there are none."""

    points: NDArray[np.float32]
    pixels: NDArray[np.float32]


class LossScales(NamedTuple):
    """Scales of the three losses, and the least depth of matched points."""

    appearance: float
    outline: float
    points: float
    nearest: float


class DrawingBuffers(NamedTuple):
    """What `terms_of_pose` writes on its way, to be used again.

    Attributes:
        x_cam: ``(V, 3)`` vertices in the camera, and
        screen: ``(V, 2)`` on the screen.
        face_index: ``(S, S)`` faces, and
        inverse_depth: ``(S, S)`` of what is drawn.
    """

    x_cam: NDArray[np.float32]
    screen: NDArray[np.float32]
    face_index: NDArray[np.int64]
    inverse_depth: NDArray[np.float32]


SURFACE = record(
    SurfaceArrays,
    float32[:, ::1], int64[:, ::1], float32[:, :, ::1], int64[:, ::1], int64[::1], float32[:, :, ::1],
)  # fmt: skip
TARGET = record(
    TargetArrays,
    float32[:, :, ::1], float32[:, ::1], boolean[:, ::1], boolean[:, ::1], float32[:, ::1], float32[:, ::1],
)  # fmt: skip
MATCHES = record(MatchArrays, float32[:, ::1], float32[:, ::1])
SCALES = record(LossScales, float64, float64, float64, float64)


def packed(
    surface: Surface, target: PoseTarget, matched: MatchedPoints | None
) -> tuple[SurfaceArrays, TargetArrays, MatchArrays]:
    """The arrays that `terms_of_pose` takes first; what a frame does not have is empty.

    Raises:
        IndexError: If faces name vertices that are not there.
    """
    check_corners(surface.faces, surface.vertices[None])
    none = target.comparable.new_zeros(0, 0)
    mesh = surface.vertices, surface.faces, surface.face_uvs, *surface.edges, surface.layers
    frame = (
        target.features.permute(1, 2, 0),
        target.comparable,
        target.inside,
        none.bool() if target.mask is None else target.mask,
        none if target.distance is None else target.distance,
        target.K,
    )
    points = (none, none) if matched is None else (matched.points, matched.pixels)
    return (
        SurfaceArrays(*map(array, mesh)),
        TargetArrays(*map(array, frame)),
        MatchArrays(*map(array, points)),
    )


@numba.njit(**OPTIONS)
def drawing_buffers(vertices, comparable):
    """Memory for V vertices and a frame's pixels."""
    return DrawingBuffers(
        np.empty_like(vertices),
        np.empty((len(vertices), 2), np.float32),
        np.empty(comparable.shape, np.int64),
        np.empty(comparable.shape, np.float32),
    )
