"""Lenses with distortion: there and back, against OpenCV, and where they end."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.geometry.lens import LEAST_ZOOM, Lens

WIDTH, HEIGHT = 320, 200
TAKEN = (230.0, 233.0, 166.0, 95.0)
LENSES = {
    "barrel": ("radtan", (-0.28, 0.08, 0.001, -0.002)),
    "pincushion": ("radtan", (0.2, -0.05, 0.0, 0.001, 0.01)),
    "rational": ("radtan", (0.1, 0.02, 0.0, 0.0, 0.001, 0.15, 0.02, 0.0)),
    "prism": ("radtan", (-0.2, 0.05, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, -0.01, 0.02, 0.0)),
    "fisheye": ("fisheye", (-0.02, 0.003, -0.001, 0.0002)),
    "equidistant": ("fisheye", (0.0, 0.0, 0.0, 0.0)),
}


@pytest.fixture(params=LENSES)
def lens(request) -> Lens:
    model, k = LENSES[request.param]
    return Lens.of(model, k, TAKEN, WIDTH, HEIGHT)


def test_distorting_is_opencv_s(lens):
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    fx, fy, cx, cy = TAKEN
    K, k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(lens.coefficients)
    if lens.model == "fisheye":
        radius = np.linalg.norm(rays, axis=1)
        theta = np.arctan(radius)
        bent = theta * (1 + sum(one * theta ** (2 * n + 2) for n, one in enumerate(k)))
        expected = rays * (bent / radius)[:, None] * (fx, fy) + (cx, cy)
    else:
        points = np.column_stack([rays, np.ones(50)])
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, k)[0].reshape(-1, 2)
    found = lens.to_picture(rays * lens.pinhole[:2] + lens.pinhole[2:])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_there_and_back_for_every_pixel(lens):
    rows, columns = np.mgrid[:HEIGHT:5, :WIDTH:5]
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    seen = lens.to_pinhole(pixels)
    assert np.isfinite(seen).all()
    np.testing.assert_allclose(lens.to_picture(seen), pixels, atol=1e-4)


def test_all_of_the_picture_is_kept(lens):
    assert lens.kept == pytest.approx(1.0, abs=0.01)
    assert LEAST_ZOOM <= lens.pinhole[0] / lens.picture[0] <= 1


def test_a_mask_comes_back_as_it_was(lens):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[60:150, 90:230] = True
    there = lens.mask_to_pinhole(mask)
    back = lens.mask_to_picture(there)
    assert there.dtype == back.dtype == np.bool_
    assert (mask & back).sum() / (mask | back).sum() > 0.98


def test_straight_lines_of_the_world_are_straight_again(lens):
    """A soft grid drawn by the formula, undistorted, is the grid."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    seen = lens.to_pinhole(np.column_stack([columns.ravel(), rows.ravel()])).reshape(HEIGHT, WIDTH, 2)

    def grid(x, y):
        return 127 + 60 * np.sin(x / 9) + 60 * np.sin(y / 9)

    taken = np.repeat(grid(seen[..., 0], seen[..., 1])[..., None], 3, 2).round().astype(np.uint8)
    found = lens.undistort(taken)[..., 0].astype(float)
    inside = lens.mask_to_pinhole(np.ones((HEIGHT, WIDTH), bool))
    inside = cv2.erode(inside.astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert np.abs(found - grid(columns, rows))[inside].mean() < 3.5


def test_what_the_lens_does_not_see_is_nowhere():
    lens = Lens.of("radtan", (-0.28, 0.0, 0.0, 0.0), TAKEN, WIDTH, HEIGHT)
    far = np.array([[1e5, 0.0], [np.nan, 3.0], [lens.pinhole[2], lens.pinhole[3]]])
    found = lens.to_picture(far)
    assert np.isnan(found[:2]).all()  # the polynomial would fold it back into the picture
    np.testing.assert_allclose(found[2], TAKEN[2:], atol=1e-9)
    assert np.isnan(lens.to_pinhole(np.array([[np.inf, 0.0]]))).all()
    assert len(lens.to_pinhole(np.zeros((0, 2)))) == 0


@pytest.mark.parametrize("k", [(-3.0, 0, 0, 0), (-9.0, 1.0, 0, 0), (-5.0, 0, 0, 0)])
def test_what_no_lens_does_is_refused(k):
    with pytest.raises(InputError, match="folds pictures"):
        Lens.of("radtan", k, TAKEN, WIDTH, HEIGHT)


def test_a_camera_with_its_lens_is_kept_with_the_state_of_a_run(tmp_path):
    """As a stopped run goes on with it: equal, and still of use as a key."""
    import json

    from tracking3d.geometry.camera import Camera
    from tracking3d.results.checkpoint.serialization import TreeFolder

    model, k = LENSES["barrel"]
    lens = Lens.of(model, k, TAKEN, WIDTH, HEIGHT)
    camera = Camera(*lens.pinhole, WIDTH, HEIGHT, "file", lens=lens)
    trees = TreeFolder(tmp_path, (Camera, Lens))
    again = TreeFolder(tmp_path, (Camera, Lens)).read(json.loads(trees.text(camera)))
    assert again == camera and hash(again) == hash(camera)
    assert again.lens.kept == lens.kept
