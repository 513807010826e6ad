"""Fixtures of the video tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sample_videos import encode_video, moving_picture


@pytest.fixture
def clip(tmp_path: Path) -> Callable[..., Path]:
    """Makes a video of 30 small frames (see `encode_video` for the arguments)."""

    def make(name: str = "clip.mp4", **how: Any) -> Path:
        return encode_video(tmp_path / name, [moving_picture(index) for index in range(30)], **how)

    return make
