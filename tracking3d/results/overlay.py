"""The overlay: one frame with its estimates drawn in.

The picture has the outline of the initial mask (thin, orange) and of the estimate (thicker, cyan), the object's
axes (x red, y green, z blue) and below it a status bar, with the reason in lines of its own. Axes are drawn if the
pose is trusted: in frames that are tracked, and if they begin on the object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.frames import Frame, Image
from tracking3d.geometry.camera import Camera
from tracking3d.results import drawing
from tracking3d.results.records import FrameRecord

NARROWEST, WIDEST = 320, 1920
_WIDE = 640  # pixels in which a reason fits in one line
_LEADING = 0.75  # height of a further line of text, compared with the first
_REASON: drawing.Colour = (170, 170, 175)
_AXIS_COLOURS: tuple[drawing.Colour, ...] = ((255, 60, 60), (60, 220, 60), (80, 120, 255))


@dataclass(frozen=True)
class OverlaySize:
    """Layout of the overlay of one camera."""

    scale: float  # overlay pixels per frame pixel
    width: int  # width of picture and bar, even
    picture: int  # height of the picture
    bar: int  # height of the status bar below it; the sum is even
    line: int  # height of one line of text in the bar: the first has the figures, those below it the reason

    @classmethod
    def of(cls, camera: Camera) -> OverlaySize:
        """The frame's own size, unless its text could not be read or the video would be needlessly large."""
        scale = min(max(1.0, NARROWEST / camera.width), WIDEST / camera.width)
        width, picture = 2 * round(camera.width * scale / 2), max(round(camera.height * scale), 1)
        line = max(22, round(width / 30))
        # A reason of a hundred letters needs two lines in a narrow picture.
        bar = line + round(_LEADING * line) * (1 if width >= _WIDE else 2)
        return cls(scale, width, picture, bar + (picture + bar) % 2, line)

    @property
    def height(self) -> int:
        """Height of picture and bar together."""
        return self.picture + self.bar


@dataclass(frozen=True, eq=False)
class ObjectAxes:
    """Position of the axes, in object coordinates."""

    origin: NDArray[np.float64]  # (3,)
    length: float  # about the object's radius

    @classmethod
    def of(cls, estimate: FrameEstimate, camera: Camera) -> ObjectAxes | None:
        """The object's middle and radius as one mask and pose show them; None if they show nothing.

        The mesh is known at the end only, so the mask's middle is taken at the depth of the object's origin.
        """
        depth = float(estimate.T_cam_obj[2, 3])
        rows, columns = np.nonzero(estimate.mask)
        if not len(rows) or not np.isfinite(estimate.T_cam_obj).all() or depth <= 0:
            return None
        pixel = camera.to_pinhole(np.array([[columns.mean(), rows.mean()]]))[0]
        if not np.isfinite(pixel).all():
            return None
        middle = depth * np.linalg.solve(camera.K, np.array([*pixel, 1.0]))
        rotation, translation = estimate.T_cam_obj[:3, :3], estimate.T_cam_obj[:3, 3]
        return cls(rotation.T @ (middle - translation), math.sqrt(len(rows) / math.pi) * depth / camera.fx)


def draw_overlay(
    frame: Frame, estimate: FrameEstimate, record: FrameRecord, camera: Camera, axes: ObjectAxes | None
) -> Image:
    """Draw one overlay.

    Args:
        frame: The input.
        estimate: The estimate for it.
        record: The same estimate as it is recorded.
        camera: The camera of the full frame.
        axes: The object's axes; None leaves them out. So does a frame that is not tracked, and a pose that puts
            them on the background.

    Returns:
        ``(height, width, 3)`` as `OverlaySize.of` gives them.
    """
    size = OverlaySize.of(camera)
    shape = (size.width, size.picture)
    canvas = np.empty((size.height, size.width, 3), dtype=np.uint8)
    canvas[size.picture :] = drawing.PAPER
    way = cv2.INTER_AREA if size.scale < 1 else cv2.INTER_LINEAR
    picture = canvas[: size.picture]
    cv2.resize(frame.image, shape, picture, interpolation=way)
    thin = max(round(size.width / 400), 1)
    drawing.draw_outline(picture, _scale(estimate.mask, shape), drawing.REFINED, thin + 1)
    if estimate.initial_mask is not None:
        drawing.draw_outline(picture, _scale(estimate.initial_mask, shape), drawing.INITIAL, thin)
    if axes is not None and estimate.status is Status.TRACKED:
        draw_axes(picture, estimate.T_cam_obj, camera, axes, size.scale, thin + 1, estimate.mask)
    _draw_bar(canvas[size.picture :], record, size.line)
    return canvas


def _scale(mask: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    if mask.shape == shape[::-1]:
        return mask
    return cv2.resize(mask.astype(np.uint8), shape, interpolation=cv2.INTER_NEAREST).astype(bool)


def draw_axes(
    picture: Image,
    T_cam_obj: NDArray[np.float64],
    camera: Camera,
    axes: ObjectAxes,
    scale: float,
    thickness: int,
    mask: NDArray[np.bool_] | None = None,
) -> None:
    """Draw x red, y green and z blue, the nearest on top.

    Nothing is drawn if they reach behind the camera, or begin beside a mask ``(H, W)`` that is given; ``scale`` is the
    picture's, of the frame.
    """
    ends = np.concatenate([axes.origin[None], axes.origin + axes.length * np.eye(3)])
    points = ends @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    if not np.isfinite(points).all() or points[:, 2].min() <= 0:
        return
    pixels = camera.to_picture((points @ camera.K.T)[:, :2] / points[:, 2:])
    if not np.isfinite(pixels).all() or not (mask is None or _is_on(mask, pixels[0])):
        return
    pixels = np.clip((pixels + 0.5) * scale - 0.5, -1e5, 1e5).round().astype(int)
    for axis in np.argsort(-points[1:, 2]):
        cv2.line(picture, pixels[0], pixels[axis + 1], _AXIS_COLOURS[axis], thickness, cv2.LINE_AA)


def _is_on(mask: NDArray[np.bool_], pixel: NDArray[np.float64]) -> bool:
    """Whether the pixel ``(2,)`` x and y is one of the mask's, or of a hole in it.

    The middle of a mug is seen through its handle at times, that of a gate always: it does not lie on the background.
    """
    column, row = np.clip(pixel, -1, max(mask.shape)).round().astype(int)
    if not (0 <= row < mask.shape[0] and 0 <= column < mask.shape[1]):
        return False
    if mask[row, column]:
        return True
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    place = (float(column), float(row))
    return any(cv2.pointPolygonTest(outline, place, False) >= 0 for outline in outlines)


def _draw_bar(bar: Image, record: FrameRecord, line: int) -> None:
    height, width = bar.shape[:2]
    letters = round(line * 0.42)
    gap, base = letters, round((line + letters) / 2)
    left = drawing.draw_text(bar, f"#{record.index}", gap // 2, base, letters, drawing.INK)
    left = drawing.draw_text(
        bar, record.status.value, left + gap, base, letters, drawing.STATUS[record.status]
    )
    figures = [f"conf {record.confidence:.2f}"]
    if record.iou_initial is not None:
        figures.append(f"IoU {record.iou_initial:.2f}")
    for text in figures:
        left = drawing.draw_text(bar, text, left + gap, base, letters, drawing.INK)
    if record.keyframe:
        left = drawing.draw_text(bar, "key", left + gap, base, letters, drawing.KEYFRAME)
    legend = width - drawing.text_width("initial estimate", letters) - gap
    if legend > left + gap:
        after = drawing.draw_text(bar, "initial ", legend, base, letters, drawing.INITIAL)
        drawing.draw_text(bar, "estimate", after, base, letters, drawing.REFINED)
    step = round(_LEADING * line)
    for text in drawing.wrap(record.reason, letters, width - gap, (height - line) // step):
        base += step
        drawing.draw_text(bar, text, gap // 2, base, letters, _REASON)
