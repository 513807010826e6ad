"""Makes a moving picture of a finished run: the overlay, cut out around the object, beside the model in the same pose.

The pictures of the README and of docs/gallery.md, which says how their clips and runs were made:

$ python docs/images/moving_picture.py runs/truck
$ python docs/images/moving_picture.py runs/tin --out docs/images/tin.webp
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as PillowImage

from tracking3d.frames import Frame, Image
from tracking3d.results.layout import OVERLAY
from tracking3d.results.mesh_export import load_model
from tracking3d.results.mesh_view import render_view
from tracking3d.results.run_reader import RunReader
from tracking3d.video import open_source

SIDE = 280
MOST = 30
"""Pictures; of a longer run every second, third, ..."""
PAUSE = 160
"""Milliseconds a picture."""
MARGIN = 1.25
"""Side of what is cut out, in sides of the object."""


def pictures(run: RunReader) -> list[Image]:
    """``(SIDE, 2 SIDE, 3)`` each: one window around all places of the object, and the model."""
    frames = [frame for frame in run.frames if frame.index % -(-len(run.frames) // MOST) == 0]
    boxes = np.array([cv2.boundingRect(run.mask(frame.index).astype(np.uint8)) for frame in frames])
    left, top = boxes[:, :2].min(axis=0)
    right, bottom = (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
    video = {one.index: one.image for one in open_source(str(run.folder / OVERLAY)) if isinstance(one, Frame)}
    scale = next(iter(video.values())).shape[1] / run.camera.width
    rows = round(scale * run.camera.height)  # below them is the status bar
    side = min(scale * MARGIN * max(right - left, bottom - top), rows)
    x = float(np.clip(scale * (left + right) / 2, side / 2, scale * run.camera.width - side / 2))
    y = float(np.clip(scale * (top + bottom) / 2, side / 2, rows - side / 2))
    cut = slice(round(y - side / 2), round(y + side / 2)), slice(round(x - side / 2), round(x + side / 2))
    model = load_model(run.folder)
    drawn = []
    for frame in frames:
        overlay = cv2.resize(video[frame.index][:rows][cut], (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        drawn.append(np.concatenate([overlay, render_view(model, frame.T_cam_obj[:3, :3], SIDE)], axis=1))
    return drawn


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="a finished run folder")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".webp"), help="the picture")
    parser.add_argument("--quality", type=int, default=60, help="of WebP, to 100")
    arguments = parser.parse_args()
    first, *others = (PillowImage.fromarray(one) for one in pictures(RunReader(arguments.run)))
    first.save(
        arguments.out,
        save_all=True,
        append_images=others,
        duration=PAUSE,
        loop=0,
        quality=arguments.quality,
        method=4,
    )


if __name__ == "__main__":
    main()
