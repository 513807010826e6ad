"""Any frame, in any order, is the one that reading from the beginning gives."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from sample_videos import damage_packet, encode_video, moving_picture

from tracking3d.errors import InputError
from tracking3d.frames import Frame
from tracking3d.video import any_frame, open_source
from tracking3d.video.any_frame import KeptImages, frame_images

COUNT = 24
ORDER = [5, 6, 7, 3, 23, 0, 12, 11, 23, 1, 8, 2]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.mp4", {"codec": "libx264", "options": {"g": "8", "bf": "2"}}),
        ("a.mkv", {"codec": "libx264", "options": {"g": "100"}}),
        ("a.avi", {"codec": "mpeg4", "options": {"bf": "2"}}),
        ("varying.mp4", {"milliseconds": [40 * n * (1 + n % 3) for n in range(1, COUNT + 1)]}),
    ],
)
def test_a_video_is_sought_as_it_is_read(tmp_path, name, options):
    if "milliseconds" in options:
        options = {"milliseconds": sorted(set(options["milliseconds"]))[:COUNT]}
    count = len(options.get("milliseconds", range(COUNT)))
    path = encode_video(tmp_path / name, [moving_picture(n) for n in range(count)], **options)
    read = {frame.index: frame.image for frame in open_source(str(path)) if isinstance(frame, Frame)}
    images = frame_images(open_source(str(path)))
    for index in [n for n in ORDER if n < count]:
        assert np.array_equal(images.image(index), read[index]), index
    assert images.image(count) is None and images.image(-1) is None
    assert images.count in (count, None)


def test_a_damaged_picture_is_none_and_those_after_it_keep_their_place(tmp_path):
    path = encode_video(
        tmp_path / "a.mp4", [moving_picture(n) for n in range(COUNT)], options={"g": "6", "bf": "0"}
    )
    damage_packet(path, 8)
    read = {frame.index: frame.image for frame in open_source(str(path)) if isinstance(frame, Frame)}
    images = frame_images(open_source(str(path)))
    for index in (23, 13, 2, 14, 3):
        assert np.array_equal(images.image(index), read[index])


def test_images_are_found_by_their_place_in_the_folder_whatever_is_selected(tmp_path):
    for number in range(5):
        Image.fromarray(np.full((4, 6, 3), number * 40, np.uint8)).save(tmp_path / f"{number}.png")
    (tmp_path / "3.png").write_bytes(b"nonsense")
    images = frame_images(open_source(str(tmp_path), "1::2"))
    assert [None if (image := images.image(n)) is None else int(image[0, 0, 0]) for n in (4, 0, 3, 5)] == [
        160,
        0,
        None,
        None,
    ]


def test_a_source_that_gives_each_frame_once_is_refused():
    with pytest.raises(InputError, match="cannot be read again"):
        frame_images(open_source(iter([np.zeros((4, 4, 3), np.uint8)])))


def test_what_is_kept_is_bounded(monkeypatch):
    asked = []

    def decode(index: int):
        asked.append(index)
        return np.zeros((10, 10, 3), np.uint8)

    monkeypatch.setattr(any_frame, "MOST_KEPT", 1000)
    images = KeptImages(decode, 100)
    for index in (0, 1, 2, 2, 1, 0, 3, 0, 1, 2):
        images.image(index)
    assert asked == [0, 1, 2, 3, 2]
    assert sum(image.nbytes for image in images._kept.values()) <= 1000
