"""Cameras in the network: a server that speaks the protocol, and a connection that breaks off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from rtsp_server import RtspCamera, packets_of
from sample_videos import moving_picture

from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video import open_source, opening

IMAGES = [moving_picture(index) for index in range(12)]


@pytest.fixture
def camera(monkeypatch) -> Iterator[RtspCamera]:
    monkeypatch.setattr(opening, "PAUSE", 0.01)
    camera = RtspCamera(packets_of(IMAGES), most=3)
    yield camera
    camera.close()


def test_a_camera_is_played_and_asked_again_when_it_is_lost(camera, caplog):
    source = open_source(camera.address)
    assert isinstance(source, opening.LiveStream) and not source.repeatable
    items = list(source)
    # The first connection was to look; what is not a frame was dropped, since another one had come.
    assert [item.index for item in items] == list(range(2 * len(IMAGES)))
    assert all(isinstance(item, Frame) or "dropped" in item.reason for item in items)
    frames = [item for item in items if isinstance(item, Frame)]
    for frame in frames:
        away = [np.abs(frame.image.astype(float) - image).mean() for image in IMAGES]
        assert np.argmin(away) == frame.index % len(IMAGES), "the pictures that were sent, in their order"
    assert [frame.time for frame in frames] == sorted(frame.time for frame in frames)
    assert camera.methods[:4] == ["OPTIONS", "DESCRIBE", "SETUP", "PLAY"]
    assert camera.connections == 3 + opening.TRIES
    assert "trying again" in caplog.text and "could not be reconnected" in caplog.text


def test_as_many_frames_as_were_asked_for(camera):
    items = list(open_source(camera.address, ":5"))
    assert [item.index for item in items] == list(range(5))
    assert all(isinstance(item, Frame | SkippedFrame) for item in items)
