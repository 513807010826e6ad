"""Cameras by their number, with a stand-in for the device."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from tracking3d.errors import InputError
from tracking3d.frames import Frame
from tracking3d.video import FrameSource, open_source


class StandInCamera:
    """Gives 10 frames whose blue is their number, then stops, as an unplugged camera does."""

    open_devices = 0

    def __init__(self, number: int) -> None:
        self.opened = number == 2
        self.grabbed = -1
        StandInCamera.open_devices += 1

    def isOpened(self) -> bool:
        return self.opened

    def get(self, _: int) -> float:
        return 30.0

    def grab(self) -> bool:
        self.grabbed += 1
        return self.grabbed < 10

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((4, 6, 3), (self.grabbed, 0, 255), np.uint8)

    def release(self) -> None:
        StandInCamera.open_devices -= 1


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", StandInCamera)
    monkeypatch.setattr(StandInCamera, "open_devices", 0)


@pytest.mark.usefixtures("stand_in")
def test_a_number_is_a_camera() -> None:
    source = open_source("2")
    items = list(source)
    assert isinstance(source, FrameSource)
    assert (source.name, source.count, source.fps) == ("camera 2", None, 30.0)
    # It does not wait, so some may have been dropped: each is there or told of.
    assert [item.index for item in items] == list(range(10))
    frames = [item for item in items if isinstance(item, Frame)]
    assert frames[0].index == 0 and frames[-1].index == 9
    assert [tuple(frame.image[0, 0]) for frame in frames] == [(255, 0, frame.index) for frame in frames]
    times = [frame.time for frame in frames]
    assert times[0] == 0.0 and times == sorted(times)
    assert StandInCamera.open_devices == 0


@pytest.mark.usefixtures("stand_in")
def test_a_selection_ends_a_camera_and_sets_it_free() -> None:
    assert [frame.index for frame in open_source("2", "1:6:2")] == [1, 3, 5]
    frames = iter(open_source("2"))
    next(frames)
    frames.close()
    assert StandInCamera.open_devices == 0


@pytest.mark.usefixtures("stand_in")
def test_a_camera_that_fails_says_so_to_the_consumer(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: StandInCamera) -> tuple[bool, np.ndarray]:
        raise cv2.error("no signal")

    monkeypatch.setattr(StandInCamera, "retrieve", broken)
    with pytest.raises(cv2.error, match="no signal"):
        list(open_source("2"))
    assert StandInCamera.open_devices == 0


def test_a_missing_camera_is_one_sentence_and_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="Camera 97 cannot be opened"):
        open_source("97")
    assert capfd.readouterr() == ("", "")


def test_a_folder_named_by_a_number_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "0").mkdir()
    Pillow.new("RGB", (6, 4)).save(tmp_path / "0" / "1.png")
    monkeypatch.chdir(tmp_path)
    assert open_source("0").count == 1
