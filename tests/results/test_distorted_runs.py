"""A run through a lens with distortion: poses of the pinhole camera, masks and points in the pictures as taken."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.exporting import export_run
from tracking3d.export.options import ExportOptions
from tracking3d.geometry.lens import Lens
from tracking3d.results.correspondences import grid_on_object, track_points
from tracking3d.results.following import open_scene
from tracking3d.results.run_reader import RunReader


@pytest.fixture
def runs(tmp_path, turning_sphere, write_run) -> tuple[RunReader, RunReader]:
    """The same run without and with a lens; the pinhole camera is the same."""
    write_run(tmp_path / "plain", turning_sphere)
    write_run(tmp_path / "bent", turning_sphere)
    plain = RunReader(tmp_path / "plain")
    camera = plain.camera
    pinhole = camera.fx, camera.fy, camera.cx, camera.cy
    lens = Lens("radtan", (-0.3, 0.08, 0.002, -0.001), pinhole, pinhole, camera.width, camera.height)
    file = tmp_path / "bent" / "run.json"
    about = json.loads(file.read_text())
    about["camera"] = asdict(replace(camera, lens=lens))
    file.write_text(json.dumps(about))
    return plain, RunReader(tmp_path / "bent")


def test_the_lens_is_read_as_it_was_written(runs):
    lens = runs[1].camera.lens
    assert lens.model == "radtan" and lens.coefficients == (-0.3, 0.08, 0.002, -0.001)
    assert runs[1].camera_of(runs[1].frames[0]).lens == lens


def test_points_are_asked_and_answered_in_the_pictures_as_taken(runs):
    plain, bent = runs
    xy = np.array(grid_on_object(plain, 0, 24))
    taken = bent.camera.to_picture(xy)
    assert np.abs(taken - xy).max() > 1
    found, expected = track_points(bent, 0, taken), track_points(plain, 0, xy)
    np.testing.assert_array_equal(found.on_object, expected.on_object)
    np.testing.assert_allclose(found.points, expected.points, atol=1e-4)
    for row, positions in enumerate(expected.positions):
        np.testing.assert_allclose(found.positions[row], bent.camera.to_picture(positions), atol=1e-2)
    np.testing.assert_array_equal(found.visible, expected.visible)


def test_points_that_the_images_correct_are_in_the_pictures_as_taken(runs, turning_sphere):
    plain, bent = runs
    [xy] = [np.array(grid_on_object(plain, 0, 30))[:4]]
    frames = turning_sphere.frames
    bend = bent.camera.lens
    straight = open_scene(plain, frames, rounds=0).track(0, xy)
    images = [replace(frame, image=_taken(bend, frame.image)) for frame in frames]
    curved = open_scene(bent, images, rounds=0).track(0, bend.to_picture(xy))
    both = np.isfinite(straight.positions).all(2) & np.isfinite(curved.positions).all(2)
    expected = bend.to_picture(straight.positions.reshape(-1, 2)).reshape(straight.positions.shape)
    assert both.mean() > 0.5
    assert np.median(np.linalg.norm(curved.positions - expected, axis=2)[both]) < 1.0


def test_pixels_beside_the_object_are_followed_in_the_pictures_as_taken(runs, turning_sphere):
    _, bent = runs
    frames = [
        replace(frame, image=_taken(bent.camera.lens, frame.image))
        for frame in turning_sphere.frames
        if frame.index != 2
    ]
    tracks = open_scene(bent, frames, rounds=0).track(0, [[3.0, 4.0]], beside_object=True)
    assert tracks.kind.tolist() == ["image"]
    np.testing.assert_array_equal(tracks.positions[0], [[3.0, 4.0]])
    assert np.isnan(tracks.positions[2]).all() and np.isfinite(np.delete(tracks.positions, 2, 0)).all()


def _taken(lens: Lens, image: np.ndarray) -> np.ndarray:
    import cv2

    from tracking3d.geometry.lens import _picture_to_pinhole

    return cv2.remap(image, *_picture_to_pinhole(lens), cv2.INTER_LINEAR)


def test_masks_are_exported_as_taken_or_undistorted(runs, tmp_path):
    _, bent = runs
    as_taken, undistorted = (
        ExportedRun(bent, ExportOptions(undistorted=flag)).mask(0) for flag in (False, True)
    )
    np.testing.assert_array_equal(as_taken, bent.mask(0))
    np.testing.assert_array_equal(undistorted, bent.camera.lens.mask_to_pinhole(as_taken))
    np.testing.assert_array_equal(undistorted, bent.pinhole_mask(0))
    assert (as_taken ^ undistorted).any()
    export_run(bent.folder, "vot", tmp_path / "masks.txt", options=ExportOptions(undistorted=True))
    with pytest.raises(InputError, match="has no use for undistorted="):
        export_run(bent.folder, "tum", tmp_path / "poses.txt", options=ExportOptions(undistorted=True))


@pytest.mark.parametrize(
    "damage",
    [
        {"model": "omni"},
        {"coefficients": [1]},
        {"coefficients": [1, 2, 3, "x"]},
        {"coefficients": [1, 2, 3, float("nan")]},
        {"pinhole": [0, 0, 0, 0]},
        {"picture": None},
        {"width": 5},
    ],
)
def test_a_damaged_lens_is_refused(runs, damage):
    _, bent = runs
    file = bent.folder / "run.json"
    about = json.loads(file.read_text())
    about["camera"]["lens"] |= damage
    file.write_text(json.dumps(about))
    with pytest.raises(InputError, match="is damaged: it names no camera"):
        RunReader(bent.folder).camera  # noqa: B018
