"""Rating and refining proposed masks by the object's colours and an independent box."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop, crop_window
from tracking3d.trackers.colour_models import GlobalColours, lab
from tracking3d.trackers.confidence import Judgement, inside_distance, outline_margin
from tracking3d.trackers.crops import box_iou, box_of
from tracking3d.trackers.onnx.images import Proposal, enlarge

_MARGIN, _SIZE = 0.45, 160  # of the crops that colours are taken from
_BAND = 0.05  # of the square root of the area: pixels this near the outline are of neither side
_COLOUR = 0.3  # weight of the colours' log-odds against the network's
_RADIUS = 0.06  # of the square root of the area: colours speak as means over such a neighbourhood
_HOLE = 1.3  # log-odds: clearer than this, a part of the mask is what surrounds it


@dataclass(frozen=True)
class Verdict:
    """What is thought of one proposal."""

    proposal: Proposal  # sharpened by colours
    judgement: Judgement  # of colours and the box

    @property
    def score(self) -> float:
        """How likely the mask is right, in [0, 1], by colours, the box, and how sharp the network's mask was.

        Powers are those of a few that best separated masks of IoU 0.7 and more from others on four clips and two
        networks: the area under the curve is 0.79, that of the judgement alone 0.46, since a hand in the mask
        is blurred at its cut far more often than it spoils colours or box.
        """
        return math.sqrt(self.judgement.score) * self.proposal.sharpness**4

    @property
    def score_without_box(self) -> float:
        """The same by colours alone: what can tell that the box tracker is wrong."""
        return replace(self, judgement=replace(self.judgement, agreement=None)).score

    @property
    def preference(self) -> float:
        """Orders proposals of one frame; weights are the best of a few on 200 frames of four clips."""
        agreement = self.judgement.agreement or 0.0
        return self.judgement.separation + 0.3 * agreement + 0.3 * self.proposal.sharpness


class ColourJudge:
    """Knows the object's colours from its first mask, and from masks that were trusted since.

    Args:
        image: ``(H, W, 3)`` RGB, the first frame.
        mask: ``(H, W)`` in [0, 1], the object in it.
    """

    def __init__(self, image: Image, mask: NDArray[np.float32]) -> None:
        crop = _crop(image, box_of(mask) or (0.0, 0.0, float(mask.shape[1]), float(mask.shape[0])))
        self._colours = GlobalColours(crop.lab, *_sides(mask, crop))

    def verdict(self, image: Image, proposal: Proposal, tracked_box: Box | None) -> Verdict:
        """Sharpen a proposal by the colours and judge it.

        Args:
            image: ``(H, W, 3)`` RGB.
            proposal: What a network proposes.
            tracked_box: ``(x, y, w, h)``, a box tracker's opinion, or None if it has none.
        """
        mask = self._sharpen(image, proposal.mask)
        return Verdict(replace(proposal, mask=mask), self._judge(image, mask, tracked_box))

    def learn(self, image: Image, mask: NDArray[np.float32]) -> None:
        """Let the colours follow a mask that is trusted."""
        if (box := box_of(mask)) is not None:
            crop = _crop(image, box)
            self._colours.update(crop.lab, *_sides(mask, crop))

    def corrected(self, image: Image, mask: NDArray[np.float32]) -> ColourJudge:
        """This judge after a correction; a new one if the mask shows that its colours were wrong."""
        if self._judge(image, mask, None).doubt:
            return ColourJudge(image, mask)
        self.learn(image, mask)
        return self

    def _judge(self, image: Image, mask: NDArray[np.float32], tracked_box: Box | None) -> Judgement:
        box = box_of(mask)
        if box is None:
            return Judgement(0.0, 0.0, 0.0, believed=False)
        crop = _crop(image, box)
        inside, around = _sides(mask, crop)
        separation = self._colours.separation(crop.lab, inside, around)
        margin = outline_margin(self._colours.log_ratio(crop.lab), inside)
        return Judgement(separation, margin, None if tracked_box is None else box_iou(box, tracked_box))

    def _sharpen(self, image: Image, mask: NDArray[np.float32]) -> NDArray[np.float32]:
        """The network's probabilities combined with the colours; nothing is added where the network found nothing."""
        box = box_of(mask)
        if box is None:
            return mask
        place = enlarge(box, 1.5, image.shape)
        shares = np.clip(mask[place], 0.02, 0.98)
        colours = _smooth(self._colours.log_ratio(lab(image[place])), _RADIUS, mask)
        odds = (shares / (1.0 - shares)) * np.exp(_COLOUR * colours)
        sharpened = np.zeros_like(mask)
        sharpened[place] = np.where(shares > 0.02, odds / (1.0 + odds), 0.0)
        return sharpened


def background_points(image: Image, mask: NDArray[np.float32], most: int = 3) -> NDArray[np.float32]:
    """Points in the middle of parts of ``mask`` that look like what surrounds it: holes it should not cover.

    Only this frame's colours count, so that a side of the object never seen before is not taken for a hole.

    Args:
        image: ``(H, W, 3)`` RGB.
        mask: ``(H, W)`` in [0, 1].
        most: Largest number of points.

    Returns:
        ``(N, 2)`` x and y in pixels.
    """
    box = box_of(mask)
    if box is None:
        return np.zeros((0, 2), np.float32)
    crop = _crop(image, box)
    colours = GlobalColours(crop.lab, *_sides(mask, crop))
    rows, columns = enlarge(box, 1.0, image.shape)
    inside = mask[rows, columns] > 0.5
    log_odds = _smooth(colours.log_ratio(lab(image[rows, columns])), 0.67 * _RADIUS, mask)
    count, labels, parts, _ = cv2.connectedComponentsWithStats(
        (inside & (log_odds < -_HOLE)).astype(np.uint8)
    )
    areas = parts[:, cv2.CC_STAT_AREA]
    points = []
    for part in sorted(range(1, count), key=lambda part: -areas[part])[:most]:
        if areas[part] < 0.01 * np.count_nonzero(inside):
            break
        depth = cv2.distanceTransform((labels == part).astype(np.uint8), cv2.DIST_L2, 3)
        row, column = np.unravel_index(int(depth.argmax()), depth.shape)
        points.append((columns.start + column + 0.5, rows.start + row + 0.5))
    return np.asarray(points, np.float32).reshape(-1, 2)


def _crop(image: Image, box: Box) -> FrameCrop:
    return FrameCrop.of(image, Window.around(box, _MARGIN, _SIZE))


def _smooth(values: NDArray[np.float32], radius: float, mask: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over squares whose half side is ``radius`` times the square root of the mask's area."""
    reach = max(round(radius * math.sqrt(np.count_nonzero(mask > 0.5))), 1)
    return cv2.blur(values, (2 * reach + 1, 2 * reach + 1))


def _sides(mask: NDArray[np.float32], crop: FrameCrop) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The object's pixels in a crop, and those of the frame surely beyond its outline."""
    inside = crop_window(mask, crop.window) > 0.5
    if not inside.any():
        return inside, crop.in_frame
    beyond = inside_distance(inside) < -_BAND * math.sqrt(np.count_nonzero(inside))
    return inside, beyond & crop.in_frame
