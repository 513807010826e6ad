"""Point tracks in the form of TAP-Vid: a pickle or .npz of the data set's kind or of a tracker's predictions.

For N points in T frames, ``points`` or ``tracks`` is ``(N, T, 2)`` x and y, ``occluded`` ``(N, T)``, and
``query_points``, if given, ``(N, 3)`` t, y and x. (0, 0) is the outer corner of the top-left pixel, as in TAP-Vid;
here it is that pixel's centre, so half a pixel is taken off.
https://github.com/google-deepmind/tapnet/tree/main/tapnet/tapvid
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d.errors import InputError
from tracking3d.runtime.array_files import ArrayFile, ArrayTooLargeError
from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.readers.restricted_pickle import read_pickle
from tracking3d_bench.datasets.truth import Truth

RASTER = (256, 256)
"""Width and height of TAP-Vid's raster, assumed if a file does not state one."""


_ARRAYS = ("tracks", "points", "occluded", "occlusion", "query_points")
_POSITION = 16  # bytes of x and y


@dataclass(frozen=True, eq=False)
class PointTable:
    """Follows the points that a table has; see `tracking3d_bench.datasets.answers.PointTracker`.

    Attributes:
        asked: ``(T, N, 2)`` where each point is asked for; NaN in frames where it is not.
        positions: ``(T, N, 2)`` pixels.
        visible: ``(T, N)``.
        tolerance: Pixels by which a question may differ from `asked`.
    """

    asked: NDArray[np.float64]
    positions: NDArray[np.float64]
    visible: NDArray[np.bool_]
    tolerance: float

    def __call__(self, frame: int, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Positions ``(T, M, 2)`` and visibility ``(T, M)`` of M points of a frame."""
        wanted = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        positions = np.full((len(self.positions), len(wanted), 2), np.nan)
        visible = np.zeros(positions.shape[:2], bool)
        distance = np.linalg.norm(self.asked[frame][None] - wanted[:, None], axis=2)
        distance[np.isnan(distance)] = np.inf
        if distance.shape[1]:
            nearest = distance.argmin(1)
            known = distance.min(1) <= self.tolerance
            positions[:, known], visible[:, known] = (
                values[:, nearest[known]] for values in (self.positions, self.visible)
            )
        return positions, visible


def answers_from_tapvid(
    file: Path, truth: Truth, name: str | None = None, raster: tuple[int, int] | None = None
) -> Answers:
    """Point tracks of one clip.

    Without ``query_points``, row n is about the truth's point n.

    Args:
        file: A pickle, alone or by clips' names, or an .npz file.
        truth: The clip.
        name: What the file calls the clip; None takes the truth's name, or the only clip.
        raster: Width and height that positions are in; None takes the file's ``video``, or (1, 1) if no position is
            beyond 1, or else 256 x 256.

    Raises:
        InputError: If the file cannot be read safely, lacks the clip, or its arrays do not fit it.
    """
    height, width = read_image(truth.frames[0]).shape[:2]
    arrays = _of_clip(_load(file, height * width * len(truth.frames)), file, truth, name)
    tracks = _array(arrays, ("tracks", "points"), file, (None, len(truth.frames), 2))
    occluded = _array(arrays, ("occluded", "occlusion"), file, tracks.shape[:2]) > 0
    if not np.isfinite(tracks).all(2).any():
        what = "no tracks" if not len(tracks) else "no track with a finite position"
        raise InputError(f"{file} has {what}, so there is nothing to score; export the tracks again.")
    queries = None
    if "query_points" in arrays:
        queries = _array(arrays, ("query_points",), file, (len(tracks), 3))
    scale = np.array([width, height]) / _raster(arrays, tracks, raster, file)
    positions = (tracks * scale - 0.5).transpose(1, 0, 2)
    visible = ~occluded.T & np.isfinite(positions).all(2)
    asked = _query_frames(queries, truth, scale, positions.shape, file)
    # A query may be rounded to whole pixels of its raster.
    tracker = PointTable(
        asked, positions, visible, max(1.0, float(scale.max())) if queries is not None else 0.01
    )
    return Answers(
        origin=file,
        asked=range(len(truth.frames)),
        answered=frozenset(range(len(truth.frames))),
        points=tracker,
    )


def _load(file: Path, most: int) -> Any:
    """What the file holds; from an .npz, the arrays of tracks, of at most so many positions."""
    if file.suffix.lower() != ".npz":
        return read_pickle(file)
    try:
        with ArrayFile(file) as arrays:
            # The clip's own video is large, and only its size is needed.
            sizes = [name for name in arrays.names if name == "video"]
            return {
                **{name: np.broadcast_to(np.uint8(0), arrays.header(name).shape) for name in sizes},
                **{name: arrays.read(name, _POSITION * most) for name in _ARRAYS if name in arrays.names},
            }
    except FileNotFoundError as error:
        raise InputError(f"There is no file {file}; check the path.") from error
    except ArrayTooLargeError as error:
        raise InputError(
            f"{file} has more tracks than a frame of this clip has pixels ({error}); see TAP-Vid's format."
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as plain arrays ({error}); restore it.") from error


def _of_clip(document: Any, file: Path, truth: Truth, name: str | None) -> Mapping[str, Any]:
    if not isinstance(document, dict) or not document:
        raise InputError(f"{file} holds no dict of clips or arrays; see TAP-Vid's format.")
    if "tracks" in document or "points" in document:
        return document
    name = name or (truth.name if truth.name in document or len(document) > 1 else next(iter(document)))
    clip = document.get(name)
    if not isinstance(clip, dict):
        raise InputError(f"{file} has no clip {name}; give the clip's name in that file.")
    return clip


def _array(
    arrays: Mapping[str, Any], keys: tuple[str, ...], file: Path, shape: tuple[int | None, ...]
) -> NDArray[np.float64]:
    """The first of ``keys`` as numbers of that shape, None standing for any length; a leading 1 is taken off."""
    key = next((key for key in keys if key in arrays), None)
    if key is None:
        raise InputError(f"{file} has no {' or '.join(keys)}; see TAP-Vid's format.")
    try:
        values = np.asarray(arrays[key])
        if values.dtype.kind not in "fiub":
            raise ValueError(f"its type is {values.dtype}")
        values = values.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{key} of {file} is not an array of numbers ({error}); see TAP-Vid's format."
        ) from error
    if values.ndim == len(shape) + 1 and len(values) == 1:
        values = values[0]
    fits = values.ndim == len(shape) and all(b in (a, None) for a, b in zip(values.shape, shape, strict=True))
    if not fits:
        wanted = ", ".join("N" if length is None else str(length) for length in shape)
        raise InputError(f"{key} of {file} must be ({wanted}) for this clip, not {values.shape}.")
    return values


def _raster(
    arrays: Mapping[str, Any], tracks: NDArray[np.float64], raster: tuple[int, int] | None, file: Path
) -> NDArray[np.float64]:
    """Width and height that positions are relative to."""
    if raster is not None:
        if min(raster) <= 0:
            raise InputError(f"A raster of {raster[0]} x {raster[1]} has no size; give its width and height.")
        return np.array(raster, dtype=np.float64)
    finite = tracks[np.isfinite(tracks)]
    if not finite.size or np.quantile(np.abs(finite), 0.9) <= 1:
        return np.ones(2)  # a few points may be outside the picture
    shape = np.shape(arrays.get("video", ()))
    if len(shape) >= 4:
        return np.array([shape[-2], shape[-3]], dtype=np.float64)
    if np.quantile(finite, 0.9) > max(RASTER):
        raise InputError(f"{file} has positions beyond 256 x 256 pixels; specify their raster.")
    return np.array(RASTER, dtype=np.float64)


def _query_frames(
    queries: NDArray[np.float64] | None,
    truth: Truth,
    scale: NDArray[np.float64],
    shape: tuple[int, ...],
    file: Path,
) -> NDArray[np.float64]:
    """``(T, N, 2)`` pixels; NaN where a point is not asked for."""
    if queries is None:
        if truth.points is None or truth.points.positions.shape != shape:
            raise InputError(
                f"{file} has {shape[1]} tracks but no query_points, and the clip {truth.name} has another "
                "number of true points; add query_points."
            )
        return truth.points.positions
    frames = queries[:, 0].round()
    if not (np.isfinite(queries).all() and ((frames >= 0) & (frames < shape[0])).all()):
        raise InputError(f"query_points of {file} are not t, y, x in frames 0 to {shape[0] - 1}.")
    asked = np.full(shape, np.nan)
    asked[frames.astype(int), np.arange(shape[1])] = queries[:, [2, 1]] * scale - 0.5
    return asked
