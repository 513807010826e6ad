"""How fast images follow each other, where somebody says so."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from tracking3d.errors import InputError
from tracking3d.video import open_source


@pytest.fixture
def folder(tmp_path):
    for index in range(7):
        Image.new("RGB", (16, 12)).save(tmp_path / f"{index}.png")
    return tmp_path


def test_images_have_the_times_of_their_index(folder):
    source = open_source(folder, "1:7:2", fps=25)
    assert source.fps == 12.5
    assert [frame.time for frame in source] == [0.04, 0.12, 0.2]


def test_arrays_have_them_too():
    source = open_source([np.zeros((4, 4, 3), np.uint8)] * 3, fps=2)
    assert source.fps == 2 and [frame.time for frame in source] == [0, 0.5, 1]


def test_nobody_knows_where_nobody_says(folder):
    source = open_source(folder)
    assert source.fps is None and [frame.time for frame in source] == [None] * 7


@pytest.mark.parametrize("fps", [0, -1, float("nan"), float("inf"), 1e9, "25", True])
def test_what_is_no_rate_is_refused(folder, fps):
    with pytest.raises(InputError, match="is not a frame rate"):
        open_source(folder, fps=fps)


def test_a_video_keeps_its_own(tmp_path):
    from sample_videos import encode_video, moving_picture

    with pytest.raises(InputError, match="has its own time stamps; fps= is for images"):
        open_source(encode_video(tmp_path / "clip.mp4", [moving_picture(0)] * 3), fps=25)
