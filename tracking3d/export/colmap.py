"""A COLMAP model of the object: the camera moves about the still object.

::

    sparse/0/cameras, images, points3D    .txt or .bin
    images/000000.jpg                     the pictures of frames with a pose
    masks/000000.jpg.png                  255 is the object; COLMAP and splatting tools leave out what is 0

The world is the object: COLMAP's poses map world to camera with OpenCV's axes, which is ``T_cam_obj``. In COLMAP pixel
(0.5, 0.5) is the centre of the top-left one, so half a pixel is added. Points are vertices of the mesh that are seen in
two frames or more, with their colours and where they are seen. Format: https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.export.axes import quaternion
from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.seen_surface import find_seen_surface
from tracking3d.export.training_images import picture_name, write_pictures

CENTRE = 0.5
"""Of the top-left pixel, in COLMAP's and nerfstudio's coordinates."""
_PINHOLE = 1
"""Number of the camera model with fx, fy, cx, cy."""
_LEAST_VIEWS = 2


@dataclass(frozen=True)
class _Camera:
    number: int
    width: int
    height: int
    parameters: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class _Image:
    """An image with ``(P, 2)`` pixels and ``(P,)`` numbers of the points that are seen there."""

    number: int
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    camera: int
    name: str
    pixels: NDArray[np.float64]
    points: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Point:
    """A point with ``(L, 2)`` image numbers and positions within their lists of points."""

    number: int
    place: NDArray[np.float64]
    colour: NDArray[np.uint8]
    track: NDArray[np.int64]


@dataclass(frozen=True)
class _Model:
    cameras: list[_Camera]
    images: list[_Image]
    points: list[_Point]


def write_colmap(run: ExportedRun, folder: Path, binary: bool) -> None:
    """Write the model, and the pictures and masks unless they were not wanted."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model = _model_of(run)
    (_write_binary if binary else _write_text)(sparse, model)
    if run.options.images:
        write_pictures(run, folder / "images", folder / "masks", "{image}.png")


write_colmap_text = partial(write_colmap, binary=False)
write_colmap_binary = partial(write_colmap, binary=True)


def _model_of(run: ExportedRun) -> _Model:
    surface = find_seen_surface(run)
    kept = np.flatnonzero(surface.seen.sum(0) >= _LEAST_VIEWS)
    number_of = np.zeros(len(surface.points), np.int64)
    number_of[kept] = np.arange(1, len(kept) + 1)
    lenses: dict[tuple[float, float, float, float], _Camera] = {}
    images, tracks = [], [[] for _ in range(len(kept) + 1)]  # type: ignore[var-annotated]
    for row, one in enumerate(run.poses):
        camera = one.camera
        lens = camera.fx, camera.fy, camera.cx + CENTRE, camera.cy + CENTRE
        used = lenses.setdefault(lens, _Camera(len(lenses) + 1, camera.width, camera.height, lens))
        seen = np.flatnonzero(surface.seen[row] & (number_of > 0))
        images.append(
            _Image(
                row + 1,
                quaternion(one.T_cam_obj),
                one.T_cam_obj[:3, 3],
                used.number,
                picture_name(run, one.index),
                surface.pixels[row, seen] + CENTRE,
                number_of[seen],
            )
        )
        for position, vertex in enumerate(seen):
            tracks[number_of[vertex]].append((row + 1, position))
    points = [
        _Point(n, surface.points[vertex], surface.colours[vertex], np.array(tracks[n]))
        for n, vertex in enumerate(kept, 1)
    ]
    return _Model(list(lenses.values()), images, points)


def _write_text(folder: Path, model: _Model) -> None:
    cameras = (
        f"{one.number} PINHOLE {one.width} {one.height} {_joined(one.parameters)}" for one in model.cameras
    )
    _write_lines(folder / "cameras.txt", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", cameras)
    images = chain.from_iterable(
        (
            f"{one.number} {_joined(one.quaternion)} {_joined(one.translation)} {one.camera} {one.name}",
            " ".join(f"{x:.3f} {y:.3f} {n}" for (x, y), n in zip(one.pixels, one.points, strict=True)),
        )
        for one in model.images
    )
    titles = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] as X Y POINT3D_ID"
    _write_lines(folder / "images.txt", titles, images)
    points = (
        f"{one.number} {_joined(one.place)} {' '.join(map(str, one.colour))} 0 "
        + " ".join(map(str, one.track.ravel()))
        for one in model.points
    )
    _write_lines(
        folder / "points3D.txt", "POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX", points
    )


def _write_lines(path: Path, titles: str, lines: Iterable[str]) -> None:
    path.write_text("\n".join([f"# {titles}", *lines]) + "\n", encoding="ascii")


def _joined(values: Iterable[float]) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def _write_binary(folder: Path, model: _Model) -> None:
    cameras = [struct.pack("<Q", len(model.cameras))]
    for camera in model.cameras:
        cameras.append(struct.pack("<IiQQ", camera.number, _PINHOLE, camera.width, camera.height))
        cameras.append(struct.pack("<4d", *camera.parameters))
    (folder / "cameras.bin").write_bytes(b"".join(cameras))
    images = [struct.pack("<Q", len(model.images))]
    for image in model.images:
        pose = (*image.quaternion, *image.translation)
        images.append(struct.pack("<I7dI", image.number, *pose, image.camera))
        images.append(image.name.encode("ascii") + b"\0" + struct.pack("<Q", len(image.points)))
        seen = np.zeros(len(image.points), [("pixel", "<2f8"), ("point", "<u8")])
        seen["pixel"], seen["point"] = image.pixels, image.points
        images.append(seen.tobytes())
    (folder / "images.bin").write_bytes(b"".join(images))
    points = [struct.pack("<Q", len(model.points))]
    for point in model.points:
        colour = (int(value) for value in point.colour)
        points.append(struct.pack("<Q3d3BdQ", point.number, *point.place, *colour, 0.0, len(point.track)))
        points.append(point.track.astype("<u4").tobytes())
    (folder / "points3D.bin").write_bytes(b"".join(points))
