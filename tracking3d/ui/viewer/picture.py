"""A frame of the video with its estimates drawn in, layer by layer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Status
from tracking3d.frames import Image
from tracking3d.results import drawing
from tracking3d.results.overlay import ObjectAxes, draw_axes
from tracking3d.results.pictures import kept_estimate
from tracking3d.results.records import FrameRecord
from tracking3d.ui.viewer.followed_run import FollowedRun

WIDEST = 960
"""Pixels of the picture that is sent; the panel next to the model is not wider."""
CAUSAL: drawing.Colour = (255, 120, 230)
LAYERS = {"initial": drawing.INITIAL, "causal": CAUSAL, "refined": drawing.REFINED}
"""The masks whose outlines can be drawn, and their colours, from the lowest to the uppermost."""
_GREY = 70
_UNLIKELY = 0.02  # probability up to which a pixel is left as it is


@dataclass(frozen=True)
class Shown:
    """What is drawn into the picture."""

    layers: frozenset[str] = frozenset({"refined"})  # names of those of `LAYERS`
    axes: bool = True  # whether the object's axes are
    probability: bool = False  # whether the object's probability is, if it was kept


def draw_picture(
    image: Image | None,
    runs: Sequence[FollowedRun],
    index: int,
    shown: Shown,
    axes: Sequence[ObjectAxes | None],
    colours: Sequence[drawing.Colour] = (),
) -> Image:
    """One frame with the outlines and axes of all its objects.

    Args:
        image: ``(H, W, 3)``; None if the frame is not at hand.
        runs: The objects of one video.
        index: The frame.
        shown: What to draw.
        axes: Axes of each object, or None.
        colours: Colours of each object's final mask, if several are to be distinguished.

    Returns:
        ``(H, W, 3)``, at most `WIDEST` wide.
    """
    camera = runs[0].camera
    scale = min(1.0, WIDEST / camera.width)
    width, height = max(round(camera.width * scale), 1), max(round(camera.height * scale), 1)
    if image is None:
        picture = np.full((height, width, 3), _GREY, np.uint8)
        drawing.draw_text(picture, "the image of this frame is not available", 12, 30, 12, drawing.INK)
    else:
        picture = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    thin = max(round(width / 640), 1)
    for number, (run, placed) in enumerate(zip(runs, axes, strict=True)):
        record = run.frames.get(index)
        if shown.probability and (likely := run.reader.probability(index)) is not None:
            _tint(picture, likely)
        for layer, colour in LAYERS.items():
            if layer in shown.layers and (mask := run.mask(index, layer)) is not None:
                own = colours[number] if colours and layer == "refined" else colour
                small = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
                drawing.draw_outline(
                    picture, small.astype(bool), own, thin if layer == "initial" else thin + 1
                )
        if shown.axes and placed is not None and record is not None and record.status != Status.LOST:
            draw_axes(picture, record.T_cam_obj, record.through(camera), placed, scale, thin + 1)
    _draw_frame_of_doubt(picture, [run.frames.get(index) for run in runs], 2 * thin + 2)
    return picture


def beside(pictures: Sequence[Image], names: Sequence[str]) -> Image:
    """The pictures of several videos in rows of two, each with its name; one alone is left as it is."""
    if len(pictures) == 1:
        return pictures[0]
    width = WIDEST // 2
    tiles = [_add_name(picture, name, width) for picture, name in zip(pictures, names, strict=True)]
    height = max(len(tile) for tile in tiles)
    canvas = np.full((height * -(-len(tiles) // 2), 2 * width, 3), drawing.PAPER, np.uint8)
    for number, tile in enumerate(tiles):
        top, left = number // 2 * height, number % 2 * width
        canvas[top : top + len(tile), left : left + width] = tile
    return canvas


def axes_of(run: FollowedRun) -> ObjectAxes | None:
    """Where an object's axes are drawn: in the middle of its mesh, or of what its first frame shows."""
    if run.model is not None and len(run.model.vertices):
        vertices = run.model.vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        return ObjectAxes((low + high) / 2, float(np.linalg.norm(high - low)) / 3)
    for index, record in run.frames.items():
        mask = run.mask(index, "refined")
        if mask is not None and mask.any():
            return ObjectAxes.of(kept_estimate(record, mask, None, run.camera), record.through(run.camera))
    return None


def _add_name(picture: Image, name: str, width: int) -> Image:
    height = max(round(picture.shape[0] * width / picture.shape[1]), 1)
    tile = np.full((height + 22, width, 3), drawing.PAPER, np.uint8)
    tile[22:] = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    drawing.draw_text(tile, drawing.shorten(name, 10, width - 16), 8, 16, 10, drawing.INK)
    return tile


def _tint(picture: Image, probability: NDArray[np.float32]) -> None:
    """Colour what may be the object, from blue (hardly) over green (open) to yellow (surely)."""
    height, width = picture.shape[:2]
    likely = cv2.resize(probability, (width, height), interpolation=cv2.INTER_AREA)
    colours = cv2.applyColorMap(np.rint(255 * likely).clip(0, 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    share = np.where(likely > _UNLIKELY, 0.55, 0.0)[..., None]
    picture[:] = ((1 - share) * picture + share * colours[..., ::-1]).astype(np.uint8)


def _draw_frame_of_doubt(picture: Image, records: Iterable[FrameRecord | None], thickness: int) -> None:
    """A border in the colour of the worst status if a frame is uncertain or lost."""
    known = {record.status for record in records if record is not None}
    for status in (Status.LOST, Status.UNCERTAIN):
        if status in known:
            height, width = picture.shape[:2]
            colour = drawing.STATUS[status]
            cv2.rectangle(picture, (0, 0), (width - 1, height - 1), colour, 2 * thickness)
            return
