"""Rough masks of a chosen quality, with the faults of real mask trackers, made from true masks.

Every mask is a signed distance to its boundary, in units of the object's size, and every fault is a change of that
distance: so one scalar, the strength, turns all faults up together, and bisection finds the asked mean IoU.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from tracking3d.frames import Image
from tracking3d_bench.evaluation.metrics import mask_iou

TOLERANCE = 0.005
"""Tolerance of the mean IoU at which the bisection stops."""

_GRID = 32
_MARGIN = 1.0
_COLOUR_REACH = 12.0
_ONSET = 4.0
_SMALLEST_PART = 0.1
_STEPS = 40


@dataclass(frozen=True)
class Faults:
    """How much of each fault, relative to the others; 0 turns one off.

    Attributes:
        wobble: Smooth noise of the boundary, correlated in time.
        leak: Growth into the background where it resembles the object's edge.
        drift: Slow changes of place, scale and aspect, as of a tracker of boxes.
        parts: Lost parts of the object, for some frames on end.
        dropped: Share of the frames in which there is no mask at all; at most a tenth of what the IoU may lose.
        memory: Frames over which a fault comes and goes.
    """

    wobble: float = 1.0
    leak: float = 1.0
    drift: float = 1.0
    parts: float = 1.0
    dropped: float = 0.02
    memory: float = 6.0


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame's window around the object and what happens there at strength 1.

    Attributes:
        window: Rows and columns of the image.
        size: Square root of the object's area in pixels; all lengths are relative to it.
        signed: ``(h, w)`` distance to the boundary, positive inside.
        wobble: ``(h, w)`` shift of the boundary.
        leak: ``(h, w)`` growth, at least 0.
        x, y: ``(h, w)`` place relative to the object's centre.
        drift: Shift in x and y, log scale and log aspect.
        cut: Direction in radians and depth of the lost part.
        extent: Object's reach in the direction of the cut.
    """

    window: tuple[slice, slice]
    size: float
    signed: NDArray[np.float32]
    wobble: NDArray[np.float32]
    leak: NDArray[np.float32]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    drift: NDArray[np.float64]
    cut: tuple[float, float]
    extent: tuple[float, float]


def degrade_to_iou(
    masks: NDArray[np.bool_],
    images: NDArray[np.uint8],
    mean_iou: float,
    seed: int,
    faults: Faults = Faults(),
) -> NDArray[np.bool_]:
    """Rough masks whose IoU with ``masks`` is ``mean_iou`` on average over all frames but the first.

    The first frame keeps its true mask, since a tracker is given it; frames without an object stay empty. Faults
    grow over the first frames, then come and go; a dropped frame's mask is empty. One seed gives one result, and
    the same faults at every ``mean_iou``, only stronger or weaker.

    Args:
        masks: ``(N, H, W)`` true masks of what is seen.
        images: ``(N, H, W, 3)`` uint8 RGB, or N of such images; where masks leak depends on them.
        mean_iou: Above 0 and below 1; met within 0.01.
        seed: Seed of all that is random.
        faults: Which faults.

    Returns:
        ``(N, H, W)`` bool.

    Raises:
        ValueError: If ``mean_iou`` is not between 0 and 1 or these faults cannot meet it, there are fewer than two
            frames, or not as many images as masks.
    """
    if not 0 < mean_iou < 1:
        raise ValueError(f"mean_iou is {mean_iou}, not between 0 and 1")
    if len(masks) < 2 or len(images) != len(masks):
        raise ValueError(f"{len(masks)} masks and {len(images)} images; at least two of both are needed")
    frames = _plan(masks, images, mean_iou, np.random.default_rng(seed), faults)
    low, high = 0.0, np.inf
    strength = 1.0
    for _ in range(_STEPS):
        rough = _degrade(masks, frames, strength)
        excess = np.mean([mask_iou(a, b) for a, b in zip(rough[1:], masks[1:], strict=True)]) - mean_iou
        if abs(excess) <= TOLERANCE:
            return rough
        low, high = (strength, high) if excess > 0 else (low, strength)
        strength = 2 * low if high == np.inf else 0.5 * (low + high)
    raise ValueError(f"These faults do not reach a mean IoU of {mean_iou}; give more frames or other faults")


def _plan(
    masks: NDArray[np.bool_],
    images: NDArray[np.uint8],
    mean_iou: float,
    rng: np.random.Generator,
    faults: Faults,
) -> dict[int, _Frame]:
    """What happens in each frame that has an object and is not dropped, by index."""
    count = len(masks)
    onset = 1 - np.exp(-np.arange(count) / _ONSET)
    severity = onset * np.exp(0.5 * _slow(rng, count, 2 * faults.memory))
    noise = np.stack([_slow(rng, count, faults.memory, _GRID, _GRID) for _ in range(2)])
    noise = 0.8 * _smooth(noise, 3.0) + 0.6 * _smooth(noise, 1.2)
    drift = _slow(rng, count, 2 * faults.memory, 4) * (0.06, 0.06, 0.08, 0.04)
    direction = np.pi * np.cumsum(0.1 * _slow(rng, count, 2 * faults.memory)) + rng.uniform(0, 2 * np.pi)
    depth = _slow(rng, count, faults.memory)
    depth = 0.2 * np.maximum(depth - np.quantile(depth, 0.6), 0)  # a part is lost only now and then
    order = 1 + rng.permutation(count - 1)
    share = min(faults.dropped, 0.1 * (1 - mean_iou))
    dropped = {int(n) for n in order[: round(share * (count - 1))]}
    return {
        n: _frame(
            masks[n],
            images[n],
            severity[n] * faults.wobble * 0.06 * noise[0, n],
            severity[n] * faults.leak * 0.2 * np.maximum(noise[1, n] + 0.3, 0),
            severity[n] * faults.drift * drift[n],
            (float(direction[n]), float(severity[n] * faults.parts * depth[n])),
        )
        for n in range(1, count)
        if masks[n].any() and n not in dropped
    }


def _frame(
    mask: NDArray[np.bool_],
    image: Image,
    wobble: NDArray[np.float64],
    leak: NDArray[np.float64],
    drift: NDArray[np.float64],
    cut: tuple[float, float],
) -> _Frame:
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    size = float(np.sqrt(np.count_nonzero(mask)))
    side = max(width, height, size)
    margin = int(np.ceil(_MARGIN * side))
    rows = slice(max(0, y - margin), min(mask.shape[0], y + height + margin))
    columns = slice(max(0, x - margin), min(mask.shape[1], x + width + margin))
    truth = mask[rows, columns]
    signed, similarity = _signed_and_similarity(truth, image[rows, columns], size)
    centre = np.array([x + 0.5 * (width - 1), y + 0.5 * (height - 1)])
    v, u = np.indices(truth.shape, np.float32)
    u, v = (u + columns.start - centre[0]) / size, (v + rows.start - centre[1]) / size
    along = (np.cos(cut[0]) * u + np.sin(cut[0]) * v)[truth]
    # The noise moves with the object: its grid covers the largest possible window.
    step = (1 + 2 * _MARGIN) * side / (_GRID - 1)
    origin = centre - 0.5 * step * (_GRID - 1)
    to_grid = np.array(
        [[1 / step, 0, (columns.start - origin[0]) / step], [0, 1 / step, (rows.start - origin[1]) / step]]
    )
    shift, growth = (_warp(field.astype(np.float32), to_grid, truth.shape) for field in (wobble, leak))
    return _Frame(
        (rows, columns),
        size,
        signed,
        shift,
        growth * similarity,
        u.astype(np.float32),
        v.astype(np.float32),
        drift,
        cut,
        (float(along.min()), float(along.max())),
    )


def _signed_and_similarity(
    mask: NDArray[np.bool_], image: Image, size: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Signed distance in units of ``size``, and from 0 to 0.9 how like the nearest edge of the object a pixel looks."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside, nearest = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Pixel centres next to the boundary are half a pixel away from it, not one.
    signed = np.where(mask, inside - 0.5, 0.5 - outside) / size
    lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    lab = cv2.GaussianBlur(lab, (0, 0), max(1.0, 0.01 * size))
    colours = np.zeros((int(nearest.max()) + 1, 3), np.float32)
    colours[nearest[mask]] = lab[mask]
    distance = np.linalg.norm(lab - colours[nearest], axis=2)
    similarity = np.maximum(np.exp(-0.5 * (distance / _COLOUR_REACH) ** 2) - 0.1, 0)
    return signed.astype(np.float32), cv2.GaussianBlur(similarity, (0, 0), max(1.0, 0.02 * size))


def _degrade(masks: NDArray[np.bool_], frames: dict[int, _Frame], strength: float) -> NDArray[np.bool_]:
    """All masks at one strength."""
    rough = np.zeros_like(masks)
    rough[0] = masks[0]
    for n, frame in frames.items():
        rough[n][frame.window] = _rough(frame, strength)
    return rough


def _rough(frame: _Frame, strength: float) -> NDArray[np.bool_]:
    """One mask ``(h, w)`` at one strength."""
    shift_x, shift_y, scale, aspect = strength * frame.drift
    stretch = np.exp([scale + aspect, scale - aspect])
    origin = np.array([frame.x[0, 0], frame.y[0, 0]])
    # Where a pixel of the drifted mask was: (place - shift) / stretch about the object's centre.
    offset = ((origin - (shift_x, shift_y)) / stretch - origin) * frame.size
    back = np.array([[1 / stretch[0], 0, offset[0]], [0, 1 / stretch[1], offset[1]]])
    signed = _warp(frame.signed, back, frame.signed.shape) + strength * frame.leak
    direction, depth = frame.cut
    if depth > 0:
        least, most = frame.extent
        along = np.cos(direction) * frame.x + np.sin(direction) * frame.y
        edge = most - min(strength * depth, 1.0) * (most - least)
        signed = np.minimum(signed, edge - along)
    return _without_specks(signed + strength * frame.wobble > 0)


def _without_specks(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Only parts at least a tenth as large as the largest one."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count <= 2:
        return mask
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas >= _SMALLEST_PART * areas.max())[labels] & mask


def _warp(
    field: NDArray[np.float32], matrix: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.float32]:
    """``field`` at ``matrix`` (2, 3) times each pixel of an image of this ``shape``; constant past its border."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(field, matrix, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _slow(rng: np.random.Generator, count: int, memory: float, *shape: int) -> NDArray[np.float64]:
    """``(count, *shape)`` noise of unit variance that is smooth over ``memory`` frames."""
    padding = int(np.ceil(4 * memory))
    white = rng.standard_normal((count + 2 * padding, *shape))
    smooth = gaussian_filter1d(white, memory, axis=0, truncate=4.0)[padding : padding + count]
    return smooth * np.sqrt(2 * memory * np.sqrt(np.pi))


def _smooth(fields: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Unit-variance ``fields`` ``(..., h, w)`` smoothed over ``width`` cells, of unit variance again."""
    for axis in (-2, -1):
        fields = gaussian_filter1d(fields, width, axis=axis, mode="wrap") * np.sqrt(
            2 * width * np.sqrt(np.pi)
        )
    return fields
