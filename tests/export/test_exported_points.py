"""Point tracks: the same surface point in every frame, in TAP-Vid's arrays and as a table."""

from __future__ import annotations

import csv

import numpy as np

from tracking3d.results.correspondences import track_points
from tracking3d.results.run_reader import RunReader

SIZE = np.array([128, 96])


def test_tapvid_arrays_are_plain_and_in_its_coordinates(export, run):
    xy = ((62.0, 44.0), (60.0, 50.0))
    with np.load(export(run, "tapvid", frame=1, xy=xy), allow_pickle=False) as arrays:
        points, occluded, query = (arrays[name] for name in ("points", "occluded", "query_points"))
        np.testing.assert_array_equal(arrays["frames"], range(7))
    assert (points.shape, points.dtype) == ((2, 7, 2), np.float32)
    assert (occluded.shape, occluded.dtype) == ((2, 7), np.bool_)
    np.testing.assert_allclose(query[:, 0], 1)
    np.testing.assert_allclose(query[:, 2:0:-1] * SIZE - 0.5, xy, atol=1e-4)
    tracks = track_points(RunReader(run), 1, xy)
    for row, frame in enumerate(tracks.frames):
        np.testing.assert_allclose(points[:, frame] * SIZE - 0.5, tracks.positions[row], atol=1e-4)
        np.testing.assert_array_equal(occluded[:, frame], ~tracks.visible[row])
    assert occluded[:, 4].all()  # skipped
    assert occluded[:, 2].all()  # lost
    assert not occluded[:, 1].any()


def test_tapvid_is_read_back_by_the_reader_of_others_results(export, run):
    from types import SimpleNamespace

    from tracking3d_bench.datasets.readers.tapvid import answers_from_tapvid

    path = export(run, "tapvid", "out.npz", frame=1, xy=((62.0, 44.0),))
    frames = [run.parent / "video" / f"{index:03d}.png" for index in range(7)]
    truth = SimpleNamespace(frames=frames, name="clip", points=None)
    positions, visible = answers_from_tapvid(path, truth).points(1, [(62.0, 44.0)])
    np.testing.assert_allclose(positions[1, 0], (62, 44), atol=1e-4)
    assert visible[1, 0]


def test_without_pixels_a_grid_covers_the_object(export, run):
    with export(run, "points-csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    asked = [row for row in rows if row["frame"] == "0"]
    assert 50 < len(asked) < 200
    mask = RunReader(run).mask(0)
    for row in asked:
        assert mask[round(float(row["y"])), round(float(row["x"]))]
        assert (row["visible"], row["on_object"]) == ("1", "1")
