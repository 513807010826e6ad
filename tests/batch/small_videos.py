"""Videos of two frames, and where the object is in them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from recorded_runs import HEIGHT, WIDTH, frame_of

BOX = "30,20,36,24"


def write_video(path: Path, frames: int = 2) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (WIDTH, HEIGHT))
    for index in range(frames):
        writer.write(np.ascontiguousarray(frame_of(index).image[..., ::-1]))
    writer.release()
    return path
