"""Correspondences: positions and visibility in every frame of the surface points under pixels of one frame.

The mesh and the poses of a run give both: a pixel's ray meets the mesh in one surface point, which every
frame's pose carries along. A point is seen if it lies inside the frame, faces the camera and nothing of the
object is in front of it. Other things in front of the object are unknown to the mesh.
"""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.geometry.camera import NEAR, Camera
from tracking3d.points.ray_intersection import surface_under
from tracking3d.rendering.surface_visibility import DEPTH_TOLERANCE, deepest_around
from tracking3d.rendering.visibility import rasterize
from tracking3d.results.layout import OVERLAY
from tracking3d.results.records import FrameRecord, jsonable
from tracking3d.results.run_reader import RunReader


class PointKind(StrEnum):
    """How a point is tracked."""

    NONE = "none"
    """Not tracked: it lies on the background."""
    SURFACE = "surface"
    """By mesh and pose, and by the images if they are used."""
    TIED = "tied"
    """By the images while the mesh does not cover the point, and by mesh and pose once the point lies on the mesh."""
    IMAGE = "image"
    """By the images alone."""


@dataclass(frozen=True, eq=False)
class PointTracks:
    """N surface points in T frames."""

    query_frame: int  # index of the frame that the points were queried in
    query: NDArray[np.float64]  # (N, 2) the pixels asked for, x and y
    frames: NDArray[np.int64]  # (T,) int64 frame indices
    # (T, N, 2) pixels; NaN for a point that is not followed or is behind the camera
    positions: NDArray[np.float64]
    # (T, N) bool; for points on the surface false if the frame is lost or its mask empty
    visible: NDArray[np.bool_]
    # (N,) bool: whether the pixel lies on the object: on its mesh, or on its mask where points that the mesh
    # does not cover are followed
    on_object: NDArray[np.bool_]
    face: NDArray[np.int64]  # (N,) int64 face of the mesh, -1 off the object
    barycentric: NDArray[np.float64]  # (N, 3) weights of the face's corners, NaN off the object
    points: NDArray[np.float64]  # (N, 3) in object coordinates, NaN off the object
    # (T, N) pixels; twice this bounds about 19 of 20 errors. NaN if unknown.
    uncertainty: NDArray[np.float64]
    measured: NDArray[np.bool_]  # (T, N) bool: whether the image had a say
    # (N,) text, by what each is followed; see `PointKind`
    kind: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, "<U7"))


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
    query = as_points(xy)
    asked = tracked_record(run, frame)
    mesh = run.mesh()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    tolerance = DEPTH_TOLERANCE * float(np.linalg.norm(np.ptp(vertices, axis=0))) / 2

    screen, depth = project_object_points(run.camera_of(asked), asked.T_cam_obj, vertices)
    camera = run.camera_of(asked)
    seen = camera.to_pinhole(query)
    face, barycentric = surface_under(screen, depth, faces, np.nan_to_num(seen, nan=-1e6))
    on_object = (face >= 0) & in_frame(run.camera, query) & np.isfinite(seen).all(1)
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
        ahead, distance = project_object_points(camera, record.T_cam_obj, points)
        positions[row] = camera.to_picture(ahead)
        if record.status == Status.LOST or record.area == 0:
            continue
        eye = -record.T_cam_obj[:3, :3].T @ record.T_cam_obj[:3, 3]
        facing = ((eye - points) * normals).sum(1) > 0
        screen, depth = project_object_points(camera, record.T_cam_obj, vertices)
        behind = _deepest_around(camera, screen, depth, faces, ahead)
        visible[row] = on_object & facing & (distance > NEAR) & (distance <= behind + tolerance)
    indices = np.array([record.index for record in run.frames], dtype=np.int64)
    return PointTracks(
        frame,
        query,
        indices,
        positions,
        visible,
        on_object,
        face,
        barycentric,
        points,
        uncertainty=np.full(visible.shape, np.nan),
        measured=np.zeros_like(visible),
        kind=kinds(on_object),
    )


def kinds(on_surface: NDArray[np.bool_]) -> NDArray[np.str_]:
    """``(N,)`` of points that the mesh alone decides about."""
    return np.where(on_surface, PointKind.SURFACE.value, PointKind.NONE.value).astype("<U7")


def check_asked(
    tracks: PointTracks, camera: Camera, answered: NDArray[np.bool_] | None = None, otherwise: str = ""
) -> str:
    """Check that the query pixels can be tracked.

    Args:
        tracks: The tracks by the mesh.
        camera: The camera of the frames.
        answered: ``(N,)`` which pixels will have one; those on the mesh if left out.
        otherwise: What else can be done about the others.

    Returns:
        A sentence about pixels outside the object, which cannot be tracked; empty if there are none.

    Raises:
        InputError: If one lies outside the frame, or all lie outside the object.
    """

    def listed(pixels: NDArray[np.float64]) -> str:
        some = " and ".join(f"{x:g},{y:g}" for x, y in pixels[:3])
        return some + (f" and {len(pixels) - 3} more" if len(pixels) > 3 else "")

    outside = tracks.query[~in_frame(camera, tracks.query)]
    if len(outside):
        raise InputError(
            f"Frame {tracks.query_frame} has no pixel {listed(outside)}: it has {camera.width} x "
            f"{camera.height} pixels, counted from 0; give pixels on the object."
        )
    beside = tracks.query[~(tracks.on_object if answered is None else answered)]
    if not len(beside):
        return ""
    said = (
        f"These pixels of frame {tracks.query_frame} are outside the object's mesh: {listed(beside)}; give "
        "pixels inside "
        f"its outline, which {OVERLAY} shows{otherwise}."
    )
    if len(beside) == len(tracks.query):
        raise InputError(said)
    return said


def grid_on_object(run: RunReader, frame: int, step: int) -> list[tuple[float, float]]:
    """Pixels of a frame at distances of ``step`` that lie on the mesh.

    Raises:
        InputError: If the run has no mesh or no such frame, the object was lost there, or no such pixel is on it.
    """
    record = tracked_record(run, frame)
    mesh, camera = run.mesh(), run.camera_of(record)
    screen, depth = project_object_points(camera, record.T_cam_obj, np.asarray(mesh.vertices))
    rows, columns = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    pixels = np.stack([columns.ravel(), rows.ravel()], 1).astype(np.float64)
    seen = np.nan_to_num(camera.to_pinhole(pixels), nan=-1e6)
    on = pixels[surface_under(screen, depth, np.asarray(mesh.faces), seen)[0] >= 0]
    if not len(on):
        raise InputError(
            f"No point of a grid of {step} pixels lies on the object in frame {frame}; give a smaller --grid."
        )
    return [(float(x), float(y)) for x, y in on]


def project_object_points(
    camera: Camera, T_cam_obj: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project ``points`` ``(N, 3)``: ``(N, 2)`` pixels, NaN behind the camera, and ``(N,)`` depths."""
    seen = points @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    depth = seen[:, 2]
    ahead = np.where(depth > NEAR, depth, np.nan)
    return (seen @ camera.K.T)[:, :2] / ahead[:, None], depth


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


def in_frame(camera: Camera, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """``(N,)`` which pixels ``(N, 2)`` lie in the frame."""
    size = np.array([camera.width, camera.height])
    inside: NDArray[np.bool_] = np.all((xy > -0.5) & (xy < size - 0.5), axis=1)
    return inside


def on_mask(run: RunReader, frame: int, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """``(N,)`` which pixels ``(N, 2)`` of a frame lie on the object's mask."""
    inside = in_frame(run.camera, xy)
    column, row = np.where(inside[:, None], xy, 0.0).round().astype(int).T
    lies: NDArray[np.bool_] = inside & run.mask(frame)[row, column]
    return lies


def as_points(xy: ArrayLike) -> NDArray[np.float64]:
    """Pixels as ``(N, 2)``.

    Raises:
        InputError: If they are none.
    """
    try:
        query = np.asarray(xy, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"The points are not numbers ({error}); give x and y of each in pixels.") from error
    if query.ndim != 2 or query.shape[1] != 2 or not np.isfinite(query).all():
        raise InputError(
            f"The points have shape {query.shape} or are not finite; give x and y of each in pixels."
        )
    return query


def tracked_record(run: RunReader, frame: int) -> FrameRecord:
    """The record of a frame that is not lost.

    Raises:
        InputError: If the run has none.
    """
    record = next((record for record in run.frames if record.index == frame), None)
    if record is None:
        held = f"{run.frames[0].index} to {run.frames[-1].index}" if run.frames else "none"
        raise InputError(f"The run {run.folder} has no frame {frame}; choose one of its frames ({held}).")
    if record.status == Status.LOST or not np.isfinite(record.T_cam_obj).all():
        raise InputError(
            f"The object was lost in frame {frame} of {run.folder}; choose a frame that was tracked."
        )
    return record


def points_to_json(tracks: PointTracks, there: PointTracks | None = None) -> str:
    """One JSON object with the fields of `PointTracks` as nested lists; NaN is null.

    If there are tracks in another run, ``other`` has their fields.
    """
    other = {} if there is None else {"other": vars(there)}
    return json.dumps(jsonable({**vars(tracks), **other}), allow_nan=False)


COLUMNS = [
    "frame", "point", "x", "y", "visible", "on_object", "uncertainty", "measured", "X", "Y", "Z", "kind",
]  # fmt: skip


def points_to_csv(tracks: PointTracks, there: PointTracks | None = None) -> str:
    """One row a frame and point, with the columns `COLUMNS`.

    x, y and uncertainty are pixels, X, Y and Z object coordinates; empty if they are unknown. ``kind`` says by
    what a point is followed, see `PointKind`. If there are tracks in another run, a column ``run`` in front is 0, and
    1 in the rows of that one, which follow.
    """
    if there is not None:
        head, *rows = points_to_csv(tracks).splitlines()
        both = [f"run,{head}", *(f"0,{row}" for row in rows)]
        both += [f"1,{row}" for row in points_to_csv(there).splitlines()[1:]]
        return "\n".join(both) + "\n"
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    places = [[_number(value, 5) for value in point] for point in tracks.points]
    for row, frame in enumerate(tracks.frames):
        for point, (x, y) in enumerate(tracks.positions[row]):
            flags = [int(tracks.visible[row, point]), int(tracks.on_object[point])]
            unsure = _number(tracks.uncertainty[row, point], 3)
            place = [_number(x, 3), _number(y, 3)]
            measured = int(tracks.measured[row, point])
            table.writerow(
                [int(frame), point, *place, *flags, unsure, measured, *places[point], tracks.kind[point]]
            )
    return text.getvalue()


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if value == value else ""
