"""Where the surface points under some pixels of one frame are in every frame, and whether they are seen.

The mesh and the poses of a run answer both: a pixel's ray meets the mesh in one surface point, which every
frame's pose carries along. A point is seen if it lies inside the frame, faces the camera and nothing of the
object is in front of it. Other things in front of the object are unknown to the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.geometry.camera import Camera
from tracking3d.rendering.surface_visibility import DEPTH_TOLERANCE, deepest_around
from tracking3d.rendering.visibility import NEAR, rasterize
from tracking3d.results.layout import OVERLAY
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader

_EDGE = 1e-9  # barycentric slack, so that a ray through an edge does not slip between two faces
_CHUNK = 256  # points met with all faces at once


@dataclass(frozen=True, eq=False)
class PointTracks:
    """N surface points in T frames.

    Attributes:
        query_frame: Index of the frame the points were asked in.
        query: ``(N, 2)`` the pixels asked for, x and y.
        frames: ``(T,)`` int64 frame indices.
        positions: ``(T, N, 2)`` pixels; NaN for a point that is not on the object or is behind the camera.
        visible: ``(T, N)`` bool; never where the frame is lost or its mask empty.
        on_object: ``(N,)`` bool: whether the pixel lies on the object.
        face: ``(N,)`` int64 face of the mesh, -1 off the object.
        barycentric: ``(N, 3)`` weights of the face's corners, NaN off the object.
    """

    query_frame: int
    query: NDArray[np.float64]
    frames: NDArray[np.int64]
    positions: NDArray[np.float64]
    visible: NDArray[np.bool_]
    on_object: NDArray[np.bool_]
    face: NDArray[np.int64]
    barycentric: NDArray[np.float64]


def track_points(run: RunReader | Path, frame: int, xy: ArrayLike) -> PointTracks:
    """Follow the surface points under the pixels ``xy`` of one frame through the whole run.

    Args:
        run: A run with a mesh.
        frame: Index of the frame that ``xy`` is in.
        xy: ``(N, 2)`` pixels; (0, 0) is the centre of the top-left pixel.

    Raises:
        InputError: If the run has no mesh or no such frame, the frame is lost, or ``xy`` are no points.
    """
    run = run if isinstance(run, RunReader) else RunReader(run)
    query = _as_points(xy)
    asked = _find(run, frame)
    mesh = run.mesh()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    tolerance = DEPTH_TOLERANCE * float(np.linalg.norm(np.ptp(vertices, axis=0))) / 2

    screen, depth = project(run.camera_of(asked), asked.T_cam_obj, vertices)
    face, barycentric = surface_under(screen, depth, faces, query)
    on_object = (face >= 0) & _in_frame(run.camera, query)
    face, barycentric = np.where(on_object, face, -1), np.where(on_object[:, None], barycentric, np.nan)

    corners = vertices[faces[face]]
    points = np.einsum("nk,nkd->nd", barycentric, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    positions = np.full((len(run.frames), len(query), 2), np.nan)
    visible = np.zeros((len(run.frames), len(query)), dtype=bool)
    for row, record in enumerate(run.frames):
        if not np.isfinite(record.T_cam_obj).all():
            continue
        camera = run.camera_of(record)
        positions[row], distance = project(camera, record.T_cam_obj, points)
        if record.status == Status.LOST or record.area == 0:
            continue
        eye = -record.T_cam_obj[:3, :3].T @ record.T_cam_obj[:3, 3]
        facing = ((eye - points) * normals).sum(1) > 0
        screen, depth = project(camera, record.T_cam_obj, vertices)
        behind = _deepest_around(camera, screen, depth, faces, positions[row])
        visible[row] = on_object & facing & (distance > NEAR) & (distance <= behind + tolerance)
    indices = np.array([record.index for record in run.frames], dtype=np.int64)
    return PointTracks(frame, query, indices, positions, visible, on_object, face, barycentric)


def check_asked(tracks: PointTracks, camera: Camera) -> str:
    """Make sure that the pixels that were asked for can have an answer.

    Returns:
        What to say of pixels beside the object, of which nothing is known; empty where there are none.

    Raises:
        InputError: If one lies outside the frame, or all lie beside the object.
    """

    def listed(pixels: NDArray[np.float64]) -> str:
        some = " and ".join(f"{x:g},{y:g}" for x, y in pixels[:3])
        return some + (f" and {len(pixels) - 3} more" if len(pixels) > 3 else "")

    outside = tracks.query[~_in_frame(camera, tracks.query)]
    if len(outside):
        raise InputError(
            f"There is no pixel {listed(outside)} in frame {tracks.query_frame}, which has {camera.width} x "
            f"{camera.height} pixels counted from 0; give pixels on the object."
        )
    beside = tracks.query[~tracks.on_object]
    if not len(beside):
        return ""
    said = (
        f"Beside the object's mesh in frame {tracks.query_frame}: {listed(beside)}; give pixels inside its outline, "
        f"which {OVERLAY} shows."
    )
    if len(beside) == len(tracks.query):
        raise InputError(said)
    return said


def project(
    camera: Camera, T_cam_obj: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project ``points`` ``(N, 3)``: ``(N, 2)`` pixels, NaN behind the camera, and ``(N,)`` depths."""
    seen = points @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    depth = seen[:, 2]
    ahead = np.where(depth > NEAR, depth, np.nan)
    return (seen @ camera.K.T)[:, :2] / ahead[:, None], depth


def surface_under(
    screen: NDArray[np.float64], depth: NDArray[np.float64], faces: NDArray[np.int64], xy: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The nearest front-facing face under each pixel and the perspective-correct weights of its corners.

    Exact between pixel centres, unlike a look into a drawn face buffer.

    Args:
        screen: ``(V, 2)`` projected vertices.
        depth: ``(V,)`` their depths.
        faces: ``(F, 3)``.
        xy: ``(N, 2)`` pixels.

    Returns:
        ``(N,)`` face, -1 where there is none, and ``(N, 3)`` barycentric weights on the surface.
    """
    corner, z = screen[faces], depth[faces]
    ab, ac = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    with np.errstate(invalid="ignore"):
        front = np.nonzero((_cross(ac, ab) > 0) & (z.min(1) > NEAR))[0]  # y points down
    corner, z = corner[front], z[front]
    face = np.full(len(xy), -1, dtype=np.int64)
    barycentric = np.full((len(xy), 3), np.nan)
    for start in range(0, len(xy) if len(front) else 0, _CHUNK):
        to_corner = corner - xy[start : start + _CHUNK, None, None]  # (n, F, 3, 2)
        weight = _cross(np.roll(to_corner, -2, 2), np.roll(to_corner, -1, 2))
        weight = weight / weight.sum(2, keepdims=True)
        weight_by_depth = weight / z
        inverse_depth = np.where((weight >= -_EDGE).all(2), weight_by_depth.sum(2), 0.0)
        nearest = inverse_depth.argmax(1)
        row = np.arange(len(nearest))
        hit = inverse_depth[row, nearest] > 0
        on_surface = (
            weight_by_depth[row, nearest] / np.where(hit, inverse_depth[row, nearest], np.nan)[:, None]
        )
        face[start : start + _CHUNK] = np.where(hit, front[nearest], -1)
        barycentric[start : start + _CHUNK] = on_surface
    return face, barycentric


def _deepest_around(
    camera: Camera,
    screen: NDArray[np.float64],
    depth: NDArray[np.float64],
    faces: NDArray[np.int64],
    xy: NDArray[np.float64],
) -> NDArray[np.float64]:
    """``(N,)`` largest depth drawn around each point ``xy`` ``(N, 2)``, see `deepest_around`."""
    vertices = torch.tensor(np.nan_to_num(screen), dtype=torch.float32)[None]
    z = torch.tensor(depth, dtype=torch.float32)[None]
    drawn = rasterize(vertices, z, torch.tensor(faces), (camera.height, camera.width)).depth
    around: NDArray[np.float64] = deepest_around(drawn, torch.tensor(xy)[None])[0].double().numpy()
    return around


def _in_frame(camera: Camera, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    size = np.array([camera.width, camera.height])
    inside: NDArray[np.bool_] = np.all((xy > -0.5) & (xy < size - 0.5), axis=1)
    return inside


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """z of the cross product of ``(..., 2)`` vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _as_points(xy: ArrayLike) -> NDArray[np.float64]:
    try:
        query = np.asarray(xy, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"The points are not numbers ({error}); give x and y of each in pixels.") from error
    if query.ndim != 2 or query.shape[1] != 2 or not np.isfinite(query).all():
        raise InputError(
            f"The points have shape {query.shape} or are not finite; give x and y of each in pixels."
        )
    return query


def _find(run: RunReader, frame: int) -> FrameRecord:
    """The record of a frame whose pose can be relied on."""
    record = next((record for record in run.frames if record.index == frame), None)
    if record is None:
        held = f"{run.frames[0].index} to {run.frames[-1].index}" if run.frames else "none"
        raise InputError(f"The run {run.folder} has no frame {frame}; choose one that it holds ({held}).")
    if record.status == Status.LOST or not np.isfinite(record.T_cam_obj).all():
        raise InputError(
            f"The object was lost in frame {frame} of {run.folder}; choose a frame that was tracked."
        )
    return record
