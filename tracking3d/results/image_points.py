"""Points outside the mesh of a run, tracked in the images; see `tracking3d.points.image_following`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Frame
from tracking3d.points.follow import Followed, follow_points
from tracking3d.points.image_following import ImageTracks, follow_in_images
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.points.pictures import Picture, open_picture
from tracking3d.points.ray_intersection import surface_under
from tracking3d.points.surface_association import meetings, merge_image_points
from tracking3d.points.uncertainty import FEATURES
from tracking3d.results.correspondences import PointKind, PointTracks
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.progress import report_each
from tracking3d.video import FrameSource

Array = NDArray[np.float64]


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
