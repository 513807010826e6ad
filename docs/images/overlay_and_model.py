"""Makes a still picture of a finished run: five frames of the overlay, and below them the model in the same poses.

$ tracking3d demo
$ python docs/images/overlay_and_model.py demo/run --out docs/images/demo.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Frame, Image
from tracking3d.results.contact_sheet import render_view
from tracking3d.results.layout import OVERLAY
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.video import open_source

TILES, SIDE = 5, 240
QUALITY = 88


def picture(run: RunReader) -> Image:
    """``(2 SIDE, TILES SIDE, 3)``: frames evenly spread over the video, cut out around the object, and the model."""
    video = [frame.image for frame in open_source(str(run.folder / OVERLAY)) if isinstance(frame, Frame)]
    chosen = [run.frames[n] for n in np.linspace(0, len(run.frames) - 1, TILES).round().astype(int)]
    boxes = [cv2.boundingRect(run.mask(frame.index).astype(np.uint8)) for frame in chosen]
    scale = video[0].shape[1] / run.camera.width
    rows = round(scale * run.camera.height)  # below them is the status bar
    side = round(min(scale * 1.2 * max(max(box[2:]) for box in boxes), *video[0][:rows].shape[:2]))
    model = load_model(run.folder)
    columns = []
    for frame, (x, y, width, height) in zip(chosen, boxes, strict=True):
        overlay = square(video[frame.index][:rows], scale * (x + width / 2), scale * (y + height / 2), side)
        columns.append(np.concatenate([overlay, render_view(model, frame.T_cam_obj[:3, :3], SIDE)]))
    return np.concatenate(columns, axis=1)


def square(image: NDArray[np.uint8], x: float, y: float, side: int) -> Image:
    """The square around a point, moved into the image, as a tile."""
    left = round(float(np.clip(x - side / 2, 0, image.shape[1] - side)))
    top = round(float(np.clip(y - side / 2, 0, image.shape[0] - side)))
    cut = image[top : top + side, left : left + side]
    return cv2.resize(cut, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="a finished run folder")
    parser.add_argument("--out", type=Path, default=Path("overlay_and_model.jpg"), help="the picture")
    arguments = parser.parse_args()
    drawn = picture(RunReader(arguments.run))[..., ::-1]
    cv2.imwrite(str(arguments.out), drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
