"""Given intrinsics are held against the images: what no camera has is refused, what hardly one has is told."""

from __future__ import annotations

import logging

import pytest

from tracking3d.config.camera import choose_camera, warn_of_unlikely
from tracking3d.config.models import CameraConfig
from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera


def camera(*intrinsics: float) -> Camera:
    return choose_camera(CameraConfig(intrinsics=intrinsics), 640, 480)


@pytest.mark.parametrize(
    ("intrinsics", "sentence"),
    [
        ((1, 1, 320, 240), "a field of view of 180 x 180 degrees"),
        ((50_000, 50_000, 320, 240), "a field of view of 0.733 x 0.55 degrees"),
        ((500, 500, 9000, 240), "their principal point 9000, 240 lies far outside"),
        ((500, 500, 320, -600), "their principal point 320, -600 lies far outside"),
    ],
)
def test_what_no_image_of_that_size_has_is_refused(intrinsics, sentence):
    with pytest.raises(
        InputError, match=rf"^The intrinsics .*640 x 480 pixels.*{sentence}.*camera\.intrinsics"
    ):
        camera(*intrinsics)


@pytest.mark.parametrize(
    ("intrinsics", "told"),
    [
        ((500, 500, 320, 240), ""),
        ((150, 150, 320, 240), "implausible"),
        ((20_000, 20_000, 320, 240), "implausible"),
        ((500, 500, 700, 240), "lies outside the image"),
    ],
)
def test_what_hardly_one_has_is_told(intrinsics, told, caplog):
    with caplog.at_level(logging.WARNING):
        warn_of_unlikely(camera(*intrinsics))
    assert told in caplog.text and bool(told) == bool(caplog.text)


def test_nothing_is_told_of_a_field_of_view(caplog):
    warn_of_unlikely(choose_camera(CameraConfig(), 4000, 40))
    assert not caplog.text


@pytest.mark.parametrize("focal", [1e6, 1.0])
def test_a_lens_that_no_camera_has_is_left_aside_where_the_source_says_it(caplog, focal):
    known = (focal, focal, 320.0, 240.0)
    camera = choose_camera(CameraConfig(), 640, 480, known, "EXIF of 1.jpg")
    assert camera.assumed and camera == choose_camera(CameraConfig(), 640, 480)
    [record] = caplog.records
    assert "EXIF of 1.jpg" in record.message and "they are ignored" in record.message
    # Who gives it himself is asked, not overruled.
    assert choose_camera(CameraConfig(), 640, 480, (500.0, 500.0, 320.0, 240.0), "EXIF").fx == 500
