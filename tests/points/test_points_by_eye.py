"""Points of two real clips against places that were found by eye.

``data/*_by_eye.csv`` hold 20 points in every eighth frame from 0 to 72: corners and tips of what is printed on one face
of the object, chosen in frame 40 (some of the cube's by a corner detector, and looked at). In each other frame a first
guess, the face carried by the clip's reference poses, was looked at 11 times enlarged over a labelled grid, and of 9 to
15 points it was read off how far it misses. All points lie on one plane, so that the homography through the
readings of a frame places all 20; the readings lie 0.0 to 0.6 pixels from it (root mean square), and 0.0 is where none
of the guesses could be bettered. No tracker had a say. Half a pixel is what the places are good for.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import tracking3d
from tracking3d.points.image_following import follow_in_images
from tracking3d.points.pictures import Picture, open_picture
from tracking3d.video import open_source, read_image
from tracking3d_bench.evaluation.tapvid import tapvid_scores, to_tapvid_raster

ASKED = 40
CLIPS = pytest.mark.parametrize("clip", ["cube_in_hand", "box_in_hand"])


def by_eye(clip: str) -> tuple[list[int], np.ndarray]:
    """Frames, and ``(T, N, 2)`` pixels."""
    with (Path(__file__).with_name("data") / f"{clip}_by_eye.csv").open(encoding="ascii") as file:
        rows = list(csv.DictReader(file))
    frames = sorted({int(row["frame"]) for row in rows})
    places = {(int(row["frame"]), int(row["point"])): (float(row["x"]), float(row["y"])) for row in rows}
    return frames, np.array([[places[frame, point] for point in range(20)] for frame in frames])


def delta_average(found: np.ndarray, true: np.ndarray, frames: list[int]) -> float:
    """TAP-Vid's, of ``(T, N, 2)`` pixels in all frames but the one that is asked."""
    nowhere = np.zeros(true.shape[1::-1], bool)
    queries = np.column_stack([np.full(true.shape[1], frames.index(ASKED)), np.zeros((true.shape[1], 2))])
    estimated, expected = (to_tapvid_raster(one.transpose(1, 0, 2), (640, 480)) for one in (found, true))
    within = tapvid_scores(queries, nowhere, expected, nowhere, estimated, "strided").average_within
    assert within is not None
    return within


def told(error: np.ndarray, found: np.ndarray, places: np.ndarray, frames: list[int]) -> str:
    """What ``pytest -s`` shows."""
    return (
        f"median {np.median(error):.2f} pixels, delta_avg {delta_average(found, places, frames):.3f}, nine of ten "
        f"within {np.quantile(error, 0.9):.2f}"
    )


def pictures(folder: Path, last: int) -> list[Picture | None]:
    """The frames that have a mask."""
    found: list[Picture | None] = []
    for frame in range(last + 1):
        mask = folder / "masks" / f"{frame:06d}.png"
        image = folder / "frames" / f"{frame:06d}.jpg"
        found.append(
            open_picture(read_image(image), cv2.imread(str(mask), 0) > 127) if mask.is_file() else None
        )
    return found


@CLIPS
def test_the_places_lie_on_the_object(clip, shared_data):
    frames, places = by_eye(clip)
    assert frames == list(range(0, 73, 8)) and places.shape == (10, 20, 2)
    for frame, xy in zip(frames, places, strict=True):
        mask = cv2.imread(str(shared_data / clip / "masks" / f"{frame:06d}.png"), 0)
        column, row = xy.round().astype(int).T
        assert (mask[row, column] > 127).all()


@CLIPS
def test_the_images_alone_follow_them_over_forty_frames(clip, shared_data):
    frames, places = by_eye(clip)
    tracks = follow_in_images(pictures(shared_data / clip, frames[-1]), ASKED, places[frames.index(ASKED)])
    found, others = tracks.positions[frames], np.array(frames) != ASKED
    error = np.linalg.norm(found - places, axis=2)[others]
    print(f"{clip}, images alone: {told(error, found, places, frames)}")
    # The cube turns by 30 degrees until frame 72, and three frames are blurred; measured .9 and .9.
    assert np.median(error) < 1.5
    assert delta_average(found, places, frames) > 0.9
    assert (error <= 2 * tracks.uncertainty[frames][others]).mean() > 0.9
    assert tracks.visible[frames].mean() > 0.95


@pytest.mark.slow
@CLIPS
def test_a_run_from_a_box_carries_them_to_half_a_pixel(clip, shared_data):
    frames, places = by_eye(clip)
    box = json.loads((shared_data / clip / "init.json").read_text())["bbox_xywh"]
    source = open_source(shared_data / clip / "frames", "0:73")
    result = tracking3d.track(source, box=box, refine=True).result()
    tracks = result.track_points(ASKED, places[frames.index(ASKED)])
    rows = [list(tracks.frames).index(frame) for frame in frames]
    error = np.linalg.norm(tracks.positions[rows] - places, axis=2)[np.array(frames) != ASKED]
    print(f"{clip}, a run from the box: {told(error, tracks.positions[rows], places, frames)}")
    # Measured .34 and .35: what the eye is good for.
    assert np.median(error) < 0.8
    assert np.quantile(error, 0.9) < 2
    assert delta_average(tracks.positions[rows], places, frames) > 0.97
    assert tracks.visible[rows].mean() > 0.95
    assert set(tracks.kind) == {"surface"}
