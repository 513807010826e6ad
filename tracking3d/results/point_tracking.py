"""Points of a run tracked with its video; see `tracking3d.points`.

Surface and poses that were adjusted to the video are saved in the run folder, so that they are computed once.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.estimate import Status
from tracking3d.frames import Frame, Image
from tracking3d.geometry.similarity import Similarity
from tracking3d.points.follow import FEATURES, Followed, follow_points
from tracking3d.points.image_following import ImageTracks, follow_in_images
from tracking3d.points.landmark_adjustment import ROUNDS, LandmarkScene, fit_outlines, refine_scene
from tracking3d.points.pictures import Picture, open_picture
from tracking3d.points.ray_intersection import surface_under
from tracking3d.points.surface_association import meetings, merge_image_points
from tracking3d.points.view import open_view, redraw_surface
from tracking3d.results import layout
from tracking3d.results.correspondences import (
    PointKind,
    PointTracks,
    as_points,
    in_frame,
    kinds,
    on_mask,
    tracked_record,
)
from tracking3d.results.files import write_atomic
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, open_run_source
from tracking3d.runtime.array_files import ArrayFile
from tracking3d.runtime.progress import report_each, report_progress
from tracking3d.scene.surface import Drawn
from tracking3d.video import FrameSource

_LONGEST_KEY = 1024  # bytes
_DAMAGED = (OSError, ValueError)
_VERSION = 1  # of the saved file; another one is computed again
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RunScene:
    """A run with the views of its frames."""

    run: RunReader  # the run
    scene: LandmarkScene  # its surface in the frames, in their order
    # reads the whole frames, in the same order, for points that the surface does not cover; None if such points are
    # not followed
    pictures: Callable[[], list[Picture | None]] | None = None

    def track(self, frame: int, xy: ArrayLike, beside_object: bool = False) -> PointTracks:
        """Follow pixels of one frame through the whole run: predicted by surface and poses, corrected by the images.

        Pixels on the object's mask that the surface does not cover are followed in the images, until they meet it.

        Args:
            frame: Index of the frame that ``xy`` is in.
            xy: ``(N, 2)`` pixels; (0, 0) is the centre of the top-left pixel. Those that lie a few pixels beside the
                surface count as on its rim; their ``face`` is -1.
            beside_object: Follow pixels on the background too, in the images alone; else they have no estimate.

        Raises:
            InputError: If the run has no such frame, the object was lost there, or ``xy`` are no points.
        """
        query = as_points(xy)
        asked = tracked_record(self.run, frame)
        start = next(row for row, one in enumerate(self.run.frames) if one is asked)
        inside = in_frame(self.run.camera, query)
        camera = self.run.camera_of(asked)
        seen = np.where(inside[:, None], camera.to_pinhole(query), np.nan)
        report_progress("following points")
        found = follow_points(self.scene, start, seen)
        positions = camera.to_picture(found.positions.reshape(-1, 2)).reshape(found.positions.shape)
        tracks = self._tracks(frame, query, found, self.scene.views[start], seen, slice(None), positions)
        on_it = on_mask(self.run, frame, query)
        rest = np.flatnonzero(~tracks.on_object & inside & (on_it | beside_object))
        if self.pictures is None or not len(rest):
            return tracks
        points = follow_beside_mesh(self.run, self.scene, self.pictures(), start, query[rest], on_it[rest])
        return with_image_points(tracks, rest, points, on_it[rest])

    def track_in(self, other: RunScene, similarity: Similarity, frame: int, xy: ArrayLike) -> PointTracks:
        """Follow pixels of one frame through another run of the same object, with the surface of that one.

        The frame is taken for one more view of the other run, beside the one in which the object is turned most alike.

        Args:
            other: The other run.
            similarity: From this run's object coordinates to those of the other.
            frame: Index of this run's frame that ``xy`` is in.
            xy: ``(N, 2)`` pixels, see `track`.

        Returns:
            Tracks in the frames of the other run; ``face``, ``points`` and the like are of its mesh.

        Raises:
            InputError: If the run has no such frame, the object was lost in it or in all of the others, or ``xy`` are
                no points.
        """
        query, asked = as_points(xy), tracked_record(self.run, frame)
        view = self.scene.views[next(row for row, one in enumerate(self.run.frames) if one is asked)]
        views = list(other.scene.views)
        there = [row for row, one in enumerate(views) if one is not None]
        if view is None or not there:
            raise InputError(
                f"The object is not seen in frame {frame} of {self.run.folder}, or in {other.run.folder}."
            )
        T = similarity.poses(view.T_cam_obj[None])[0]
        turned = [np.trace(T[:3, :3].T @ one.T_cam_obj[:3, :3]) for one in views if one is not None]
        place = there[int(np.argmax(turned))] + 1
        view = redraw_surface(view, other.scene.vertices, other.scene.faces, T)
        views.insert(place, view)
        seen = self.run.camera_of(asked).to_pinhole(query)
        seen[~in_frame(self.run.camera, query)] = np.nan
        found = follow_points(replace(other.scene, views=views, support={}), place, seen)
        rows = [row for row in range(len(views)) if row != place]
        positions = [
            other.run.camera_of(one).to_picture(at)
            for one, at in zip(other.run.frames, found.positions[rows], strict=True)
        ]
        return other._tracks(frame, query, found, view, seen, rows, np.stack(positions))

    def _tracks(
        self,
        frame: int,
        query: Array,
        found: Followed,
        view: Drawn | None,
        seen: Array,
        rows: slice | list[int],
        positions: Array,
    ) -> PointTracks:
        """What was ``found`` in ``rows``, the frames of this run, of pixels ``seen`` ``(N, 2)`` in a ``view`` of it."""
        on_object = np.asarray(np.isfinite(found.points).all(1))
        face, barycentric = np.full(len(query), -1), np.full((len(query), 3), np.nan)
        if view is not None and on_object.any():
            face[on_object], barycentric[on_object] = surface_under(
                *view.project(self.scene.vertices), self.scene.faces, view.to_window(seen[on_object])
            )
        records = self.run.frames
        lost = np.array([one.status == Status.LOST or one.area == 0 for one in records])
        indices = np.array([one.index for one in records], dtype=np.int64)
        visible = found.visible[rows] & ~lost[:, None]
        unsure, measured = found.uncertainty[rows], found.measured[rows]
        return PointTracks(
            frame, query, indices, positions, visible, on_object, face, barycentric, found.points, unsure, measured,
            kinds(on_object),
        )  # fmt: skip


def open_scene(
    run: RunReader | Path,
    source: FrameSource | None = None,
    rounds: int = ROUNDS,
) -> RunScene:
    """Read the frames of a run and put its surface and poses right by them, unless the final refinement has done so.

    The result is written to ``landmarks.npz`` beside the mesh, and read from there the next time. If the folder
    cannot be written it is computed again each time.

    Args:
        run: A run with a mesh.
        source: Its frames; those that the run names if left out.
        rounds: See `refine_scene`; 0 leaves surface and poses as the run has them, and nothing is saved.

    Raises:
        InputError: If the run has no mesh, or its frames cannot be read or are of another size.
    """
    run = run if isinstance(run, RunReader) else RunReader(run)
    vertices, faces = _surface(run)
    images: dict[int, Drawn | None] = {}
    records = {one.index: one for one in run.frames}
    source = source if source is not None else open_run_source(run)
    for frame in report_each("reading frames", source, source.count):
        if isinstance(frame, Frame) and (record := records.get(frame.index)) is not None:
            images[frame.index] = _view(run, record, frame.image, vertices, faces)
    if not images:
        raise InputError(
            f"The video has no frame of the run {run.folder}; give the video of the run by --source."
        )
    scene = LandmarkScene([images.get(one.index) for one in run.frames], vertices, faces)
    pictures = cache(partial(read_run_images, run, source)) if getattr(source, "repeatable", True) else None
    if not rounds:
        return RunScene(run, scene, pictures)
    file = run.mesh_folder / layout.LANDMARKS
    key = _key(run, vertices, rounds)
    if (kept := _read_scene(file, key, scene)) is not None:
        return RunScene(run, kept, pictures)
    if not _is_adjusted(run):
        scene = fit_outlines(refine_scene(scene, rounds))
    nowhere = np.full((4, 4), np.nan)
    T = np.stack([nowhere if view is None else view.T_cam_obj for view in scene.views])
    _write(file, key, scene.vertices, T)
    return RunScene(run, scene, pictures)


def _is_adjusted(run: RunReader) -> bool:
    """Whether the estimates are refined ones that landmarks have adjusted.

    Another refinement of such a run took most of the time, and on 19 runs of the standard suite the share of points
    within 1 to 16 pixels was the same with it (mean .72): .02 more or less, and .09 less in one run.
    """
    return any(one.refined and "landmark_matches" in one.diagnostics for one in run.frames)


def _view(
    run: RunReader,
    record: FrameRecord,
    image: Image,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> Drawn | None:
    camera = run.camera_of(record)
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"Frame {record.index} of the video has {image.shape[1]} x {image.shape[0]} pixels, but the run "
            f"{run.folder} has {camera.width} x {camera.height}; give the run's video as --source."
        )
    if record.status == Status.LOST:
        return None
    image = camera.undistort(image)
    return open_view(image, run.pinhole_mask(record.index), camera, record.T_cam_obj, vertices, faces)


def has_landmarks(run: RunReader) -> bool:
    """Whether saved landmarks belong to the present poses and mesh of the run.

    Raises:
        InputError: If the run has no mesh.
    """
    file = run.mesh_folder / layout.LANDMARKS
    try:
        with ArrayFile(file) as kept:
            key = str(kept.read("key", _LONGEST_KEY))
    except _DAMAGED:
        return False
    return key == _key(run, _surface(run)[0], ROUNDS)


def read_landmarks(run: RunReader) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Surface ``(V, 3)`` and poses ``(T, 4, 4)`` of the landmarks that are saved for a run as it is, or None."""
    if not has_landmarks(run):
        return None
    try:
        with ArrayFile(run.mesh_folder / layout.LANDMARKS) as kept:
            return kept.read("vertices"), kept.read("T_cam_obj")
    except _DAMAGED:
        return None


def write_landmarks(run: RunReader, vertices: NDArray[np.float64], T_cam_obj: NDArray[np.float64]) -> None:
    """Save a surface ``(V, 3)`` and poses ``(T, 4, 4)`` as the landmarks of a run as it is now."""
    _write(run.mesh_folder / layout.LANDMARKS, _key(run, _surface(run)[0], ROUNDS), vertices, T_cam_obj)


def _surface(run: RunReader) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices ``(V, 3)`` and faces ``(F, 3)`` of the mesh of a run."""
    mesh = run.mesh()
    # An OBJ may hold a vertex once for each texture coordinate; to move, a surface must hang together.
    vertices, merged = np.unique(np.asarray(mesh.vertices).round(9), axis=0, return_inverse=True)
    return vertices, merged.reshape(-1)[np.asarray(mesh.faces)]


def _key(run: RunReader, vertices: NDArray[np.float64], rounds: int) -> str:
    """What the refined scene depends on."""
    parts = [vertices.tobytes(), *(one.T_cam_obj.tobytes() for one in run.frames)]
    return f"{_VERSION} {rounds} {hashlib.sha256(b''.join(parts)).hexdigest()}"


def _read_scene(file: Path, key: str, scene: LandmarkScene) -> LandmarkScene | None:
    """The scene with the saved surface and poses, if they are of the same run."""
    try:
        with ArrayFile(file) as kept:
            shapes = [kept.header(name).shape for name in ("vertices", "T_cam_obj")]
            if str(kept.read("key", _LONGEST_KEY)) != key:
                return None
            if shapes != [scene.vertices.shape, (len(scene.views), 4, 4)]:
                return None
            vertices, T = kept.read("vertices"), kept.read("T_cam_obj")
    except _DAMAGED:
        return None
    return scene.redrawn(vertices, dict(enumerate(T)))


def _write(file: Path, key: str, vertices: NDArray[np.float64], T_cam_obj: NDArray[np.float64]) -> None:
    data = io.BytesIO()
    np.savez_compressed(data, key=np.array(key), vertices=vertices, T_cam_obj=T_cam_obj)
    try:
        write_atomic(file, data.getvalue())
    except OutputError:
        return  # a folder that is only read


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """N points that started outside the mesh, in the T frames of a run."""

    # positions in pixels of the frames; points in space of those that are tied to the surface
    followed: Followed
    tied: NDArray[np.bool_]  # (N,) bool: which were found to lie on the surface in some frame
    # (N,) face of the scene's mesh that they lie on there; -1 for points that never were
    face: NDArray[np.int64]
    barycentric: Array  # (N, 3) weights of its corners; NaN for points that never were


def read_run_images(run: RunReader, source: FrameSource) -> list[Picture | None]:
    """The frames of a run, in the order of its records; None if there is no image.

    Args:
        run: The run.
        source: Its frames, which it gives once more.

    Raises:
        InputError: If they cannot be read.
    """
    indices = {one.index for one in run.frames}
    pictures = {
        frame.index: open_picture(frame.image, run.mask(frame.index))
        for frame in report_each("reading frames", source, source.count)
        if isinstance(frame, Frame) and frame.index in indices
    }
    return [pictures.get(one.index) for one in run.frames]


def follow_beside_mesh(
    run: RunReader,
    scene: LandmarkScene,
    pictures: Sequence[Picture | None],
    start: int,
    xy: Array,
    on_mask: NDArray[np.bool_],
) -> ImagePoints:
    """Follow pixels of one frame that meet no surface there.

    Args:
        run: The run.
        scene: Its surface in the frames.
        pictures: The frames.
        start: Row of the frame that the pixels are in.
        xy: ``(N, 2)`` pixels.
        on_mask: ``(N,)`` which of them are the object's; these are tied to its surface where they meet it.
    """
    tracks = follow_in_images(pictures, start, xy)
    followed, met = _by_images(tracks), np.full(len(xy), -1, np.int64)
    face, barycentric = met.copy(), np.full((len(xy), 3), np.nan)
    cameras = [run.camera_of(one) for one in run.frames]
    pinhole = np.stack([camera.to_pinhole(at) for camera, at in zip(cameras, tracks.positions, strict=True)])
    mine = np.flatnonzero(on_mask)
    met[mine] = meetings(scene, pinhole[:, mine], tracks.uncertainty[:, mine], tracks.visible[:, mine])
    for row in np.unique(met[met >= 0]).tolist():
        chosen = np.flatnonzero(met == row)
        view = scene.views[row]
        assert view is not None
        screen, depth = view.project(scene.vertices)
        pixels = view.to_window(pinhole[row, chosen])
        face[chosen], barycentric[chosen] = surface_under(screen, depth, scene.faces, pixels)
        found = follow_points(scene, row, pinhole[row, chosen])
        positions = np.stack(
            [camera.to_picture(at) for camera, at in zip(cameras, found.positions, strict=True)]
        )
        both = merge_image_points(
            Followed(
                positions, found.visible, found.uncertainty, found.measured, found.points, found.features
            ),
            tracks.positions[:, chosen],
            tracks.uncertainty[:, chosen],
            tracks.visible[:, chosen],
        )
        for name in ("positions", "visible", "uncertainty", "measured", "features"):
            getattr(followed, name)[:, chosen] = getattr(both, name)
        followed.points[chosen] = both.points
    followed.positions[start], followed.visible[start] = xy, True
    return ImagePoints(followed, met >= 0, face, barycentric)


def with_image_points(
    tracks: PointTracks, chosen: NDArray[np.int64], points: ImagePoints, on_object: NDArray[np.bool_]
) -> PointTracks:
    """Tracks with those of some points written into them.

    Args:
        tracks: Those of N points; is written to.
        chosen: ``(M,)`` which of them.
        points: Their state.
        on_object: ``(M,)`` which of them lie on the object's mask.
    """
    found = points.followed
    for name in ("positions", "visible", "uncertainty", "measured"):
        getattr(tracks, name)[:, chosen] = getattr(found, name)
    tracks.points[chosen], tracks.on_object[chosen] = found.points, on_object
    tracks.face[chosen], tracks.barycentric[chosen] = points.face, points.barycentric
    tracks.kind[chosen] = np.where(points.tied, PointKind.TIED.value, PointKind.IMAGE.value)
    return tracks


def _by_images(tracks: ImageTracks) -> Followed:
    views, count = tracks.visible.shape
    return Followed(
        tracks.positions.copy(),
        tracks.visible.copy(),
        tracks.uncertainty.copy(),
        tracks.visible.copy(),
        np.full((count, 3), np.nan),
        np.full((views, count, FEATURES), np.nan),
    )
