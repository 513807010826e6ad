"""Interlaced video: as many frames as pictures, without the comb of two moments in one."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from tracking3d.frames import Frame
from tracking3d.video import open_source
from tracking3d.video.any_frame import frame_images
from tracking3d.video.video_decoding import deinterlace

HEIGHT, WIDTH, COUNT = 64, 96, 8


def moment(fields: int) -> np.ndarray:
    """A square on a soft ground, moving by 3 pixels from field to field."""
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    left = 10 + 3 * fields
    image[16:48, left : left + 24] = 220
    return image


def woven(index: int) -> np.ndarray:
    """Even lines of one moment, odd ones of the next."""
    image = moment(2 * index)
    image[1::2] = moment(2 * index + 1)[1::2]
    return image


@pytest.fixture
def clip(tmp_path) -> Path:
    path = tmp_path / "interlaced.mkv"
    with av.open(str(path), "w") as file:
        options = {"x264-params": "tff=1:crf=2"}
        stream = file.add_stream("libx264", rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv444p"
        for index in range(COUNT):
            picture = av.VideoFrame.from_ndarray(woven(index), format="rgb24")
            picture.pts = index
            file.mux(stream.encode(picture))
        file.mux(stream.encode(None))
    return path


def combed(image: np.ndarray) -> float:
    """How much neighbouring lines differ, where lines apart by two are alike."""
    grey = image.astype(float).mean(2)
    return float(np.abs(grey[2:-2:2] * 2 - grey[1:-3:2] - grey[3:-1:2]).mean())


def apart(image: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(image.astype(int) - other.astype(int)).mean())


def test_the_comb_is_gone_and_every_frame_is_there(clip):
    source = open_source(clip)
    assert source.interlaced and source.notes == (
        "the video is interlaced; frames were deinterlaced (bwdif)",
    )
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(COUNT))
    assert [frame.time for frame in frames] == pytest.approx([index / 25 for index in range(COUNT)], abs=1e-3)
    for index, frame in enumerate(frames):
        assert isinstance(frame, Frame)
        assert combed(frame.image) < 0.35 * combed(woven(index))
        # Which of the two moments the first field is of, the encoder has said.
        assert min(apart(frame.image, moment(2 * index + field)) for field in (0, 1)) < 0.8 * apart(
            woven(index), moment(2 * index)
        )


def test_any_frame_is_the_same_as_in_order(clip):
    source = open_source(clip)
    images, frames = frame_images(source), list(source)
    for index in (5, 2, 6, 0):
        np.testing.assert_array_equal(images.image(index), frames[index].image)


def test_what_cannot_be_decoded_stays_in_its_place(clip):
    with av.open(str(clip)) as file:
        pictures = list(file.decode(video=0))
    assert all(picture.interlaced_frame for picture in pictures)
    items = [*pictures[:3], "damaged", *pictures[3:5], "damaged", "too", pictures[5]]
    given = [item if isinstance(item, str) else item.pts for item in items]
    assert [item if isinstance(item, str) else item.pts for item in deinterlace(items)] == given


def test_progressive_video_is_left_alone(tmp_path):
    from sample_videos import encode_video, moving_picture

    source = open_source(
        encode_video(tmp_path / "plain.mkv", [moving_picture(3)] * 3, codec="ffv1", pix_fmt="bgr0")
    )
    assert not source.interlaced and source.notes == ()
    np.testing.assert_array_equal(next(iter(source)).image, moving_picture(3))
