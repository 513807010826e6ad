"""Makes a moving picture of a finished run: the overlay, cropped to the object, and the model in the same pose.

docs/gallery.md says how the clips and runs of the README and the gallery were made.

$ python docs/images/moving_picture.py runs/owl --side 480 --frames 60 --pause 80
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

MARGIN = 1.25
"""Side of the crop, relative to the object's."""


def draw_pictures(run: RunReader, side: int, most: int) -> list[Image]:
    """Draw ``(side, 2 side, 3)`` pictures: one fixed crop around the object in all frames, and the model.

    Args:
        run: A finished run.
        side: In pixels.
        most: Number of pictures; of a longer run every second, third, ... frame is drawn.
    """
    frames = [frame for frame in run.frames if frame.index % -(-len(run.frames) // most) == 0]
    boxes = np.array([cv2.boundingRect(run.mask(frame.index).astype(np.uint8)) for frame in frames])
    left, top = boxes[:, :2].min(axis=0)
    right, bottom = (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
    video = {one.index: one.image for one in open_source(str(run.folder / OVERLAY)) if isinstance(one, Frame)}
    scale = next(iter(video.values())).shape[1] / run.camera.width
    rows = round(scale * run.camera.height)  # below them is the status bar
    half = min(scale * MARGIN * max(right - left, bottom - top), rows) / 2
    x = float(np.clip(scale * (left + right) / 2, half, scale * run.camera.width - half))
    y = float(np.clip(scale * (top + bottom) / 2, half, rows - half))
    crop = slice(round(y - half), round(y + half)), slice(round(x - half), round(x + half))
    model = load_model(run.folder)
    drawn = []
    for frame in frames:
        overlay = cv2.resize(video[frame.index][:rows][crop], (side, side), interpolation=cv2.INTER_AREA)
        drawn.append(np.concatenate([overlay, render_view(model, frame.T_cam_obj[:3, :3], side)], axis=1))
    return drawn


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="a finished run folder")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".webp"), help="the picture")
    parser.add_argument("--side", type=int, default=280, help="pixels; the picture is twice as wide")
    parser.add_argument("--frames", type=int, default=30, help="number of frames shown, at most")
    parser.add_argument("--pause", type=int, default=160, help="milliseconds per frame")
    parser.add_argument("--quality", type=int, default=60, help="of WebP, to 100")
    arguments = parser.parse_args()
    first, *others = (
        PillowImage.fromarray(one)
        for one in draw_pictures(RunReader(arguments.run), arguments.side, arguments.frames)
    )
    first.save(
        arguments.out,
        save_all=True,
        append_images=others,
        duration=arguments.pause,
        loop=0,
        quality=arguments.quality,
        method=6,
    )


if __name__ == "__main__":
    main()
