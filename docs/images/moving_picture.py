"""Makes a moving picture of a finished run: the video with outline and axes, and the model in the same pose.

docs/gallery.md says how the clips and runs of the README and the gallery were made.

$ python docs/images/moving_picture.py runs/owl --side 480 --frames 60 --pause 80
$ python docs/images/moving_picture.py runs/tin --out docs/images/tin.webp
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.frames import Frame, Image
from tracking3d.results.contact_sheet import render_view
from tracking3d.results.drawing import REFINED, draw_outline
from tracking3d.results.mesh_export import load_model
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, open_run_source

MARGIN = 1.2
"""Side of the crop, relative to the object's."""
ZOOM = 1.2
"""Of the model's picture, which leaves a margin around the object."""
FINER = 2
"""Pixels drawn for each pixel shown, in both directions."""
AXES = ((235, 64, 72), (64, 220, 72), (80, 120, 255))
THICKNESS = 2
"""Of the lines, in pixels shown."""


def draw_pictures(run: RunReader, side: int, most: int) -> list[Image]:
    """Draw ``(side, 2 side, 3)`` pictures: one fixed crop around the object in all frames, and the model.

    Args:
        run: A finished run; its video is read again.
        side: In pixels.
        most: Number of pictures; of a longer run every second, third, ... frame is drawn.
    """
    frames = [frame for frame in run.frames if frame.index % -(-len(run.frames) // most) == 0]
    video = {one.index: one.image for one in open_run_source(run) if isinstance(one, Frame)}
    boxes = np.array([cv2.boundingRect(run.mask(frame.index).astype(np.uint8)) for frame in frames])
    low, high = boxes[:, :2].min(axis=0), (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
    size = np.array([run.camera.width, run.camera.height])
    half = min(MARGIN * (high - low).max(), size.min()) / 2
    corner = np.clip((low + high) / 2 - half, 0, size - 2 * half)
    scale = FINER * side / (2 * half)
    crop = scale * np.array([[1, 0, -corner[0]], [0, 1, -corner[1]]])
    model = load_model(run.folder)
    drawn = []
    for frame in frames:
        left = cv2.warpAffine(video[frame.index], crop, (FINER * side, FINER * side), flags=cv2.INTER_CUBIC)
        draw_estimate(left, run, frame, model, crop)
        right = render_view(model, frame.T_cam_obj[:3, :3], round(ZOOM * FINER * side))
        margin = (len(right) - FINER * side) // 2
        right = right[margin : margin + FINER * side, margin : margin + FINER * side]
        both = np.concatenate([left, right], axis=1)
        drawn.append(cv2.resize(both, (2 * side, side), interpolation=cv2.INTER_AREA))
    return drawn


def draw_estimate(
    picture: Image, run: RunReader, frame: FrameRecord, model: ObjectModel, crop: NDArray[np.float64]
) -> None:
    """Draw the outline of the mask, and the axes of the pose if the frame was tracked."""
    mask = cv2.warpAffine(run.mask(frame.index).astype(np.float32), crop, picture.shape[1::-1])
    draw_outline(picture, mask > 0.5, REFINED, FINER * THICKNESS)
    if frame.status is not Status.TRACKED:
        return
    low, high = model.vertices.min(axis=0), model.vertices.max(axis=0)
    ends = (low + high) / 2 + 0.4 * (high - low).max() * np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    )
    points = ends @ frame.T_cam_obj[:3, :3].T + frame.T_cam_obj[:3, 3]
    pixels = run.camera.to_picture((points @ run.camera.K.T)[:, :2] / points[:, 2:])
    start, *tips = (pixels @ crop[:, :2].T + crop[:, 2]).round().astype(int)
    for axis in np.argsort(-points[1:, 2]):  # the nearest last, on top
        cv2.line(picture, start, tips[axis], AXES[axis], FINER * (THICKNESS + 1), cv2.LINE_AA)


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
