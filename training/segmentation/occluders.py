"""Drawn things that come in front of an object: hands and fingers, grippers, posts and signs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_SIDE = 200
_SKIN = ((235, 200, 175), (224, 180, 150), (200, 150, 120), (165, 115, 85), (120, 80, 60), (80, 55, 42))


def draw_hand(rng: np.random.Generator) -> Image:
    """``(200, 200, 4)`` RGBA: a forearm from below, a palm, and fingers that reach up or curl."""
    shape = np.zeros((4 * _SIDE, 4 * _SIDE), np.uint8)
    depth = np.zeros(shape.shape, np.float32)
    unit = 4 * _SIDE / 10
    palm = np.array([5.0 + rng.normal(0, 0.3), 6.0])
    wrist = palm + np.array([rng.normal(0, 0.8), 5])
    _capsule(shape, depth, palm * unit, wrist * unit, rng.uniform(0.9, 1.3) * unit)
    cv2.ellipse(shape, _pixel(palm * unit), _pixel(np.array([1.6, 1.8]) * unit), 0, 0, 360, 255, -1)
    spread = rng.uniform(-0.1, 0.5)
    for finger in range(int(rng.integers(3, 6))):
        thumb = finger == 4
        at = palm + ([1.5, -0.2] if thumb else [-1.25 + 0.8 * finger, -1.5])
        angle = (0.9 if thumb else spread * (finger - 1.5) * 0.4) + rng.normal(0, 0.1)
        start = at
        for length in (1.5, 1.1, 0.8)[: int(rng.integers(1, 4))]:
            end = start + rng.uniform(0.7, 1.1) * length * np.array([np.sin(angle), -np.cos(angle)])
            _capsule(shape, depth, start * unit, end * unit, rng.uniform(0.38, 0.48) * unit)
            start, angle = end, angle + rng.normal(0, 0.25)
    return _coloured(shape, depth, np.array(_SKIN[int(rng.integers(len(_SKIN)))], float), rng)


def with_arm(hand: Image, photograph: Image, rng: np.random.Generator) -> Image:
    """A cut-out of a hand ``(h, w, 4)``, its fingers up, with a bare arm or a sleeve below, of about its height."""
    height, width = hand.shape[:2]
    rows = slice(int(0.93 * height), height)
    columns = np.flatnonzero((hand[rows, :, 3] > 127).any(0))
    if not len(columns):
        return hand
    tall, left, right = int(rng.uniform(1.5, 2.4) * height), columns[0], columns[-1]
    canvas = np.zeros((tall, width, 4), np.uint8)
    lean = rng.normal(0, 0.15) * height
    corners = [
        (left, int(0.95 * height)),
        (right, int(0.95 * height)),
        (right + lean, tall),
        (left + lean, tall),
    ]
    alpha = np.zeros((tall, width), np.uint8)
    cv2.fillPoly(alpha, [np.array(corners, np.int32)], 255)
    canvas[..., 3] = alpha
    skin = hand[hand[..., 3] > 200][:, :3]
    colour = np.median(skin, axis=0) if len(skin) else np.full(3, 128.0)
    across = np.linspace(-1, 1, width)[None, :, None]
    arm = np.broadcast_to(colour * (1 - 0.25 * across**2), (tall, width, 3)).copy()
    if rng.random() < 0.6:  # a sleeve
        cuff = int(rng.uniform(0.9, 1.4) * height)
        cloth = cv2.resize(photograph, (width, max(tall - cuff, 1))).astype(float)
        tint = rng.uniform(0, 255, 3) if rng.random() < 0.5 else np.full(3, rng.uniform(10, 240))
        arm[cuff:] = (0.3 * cloth + 0.7 * tint)[: tall - cuff] * (1 - 0.3 * across**2)
    canvas[..., :3] = np.clip(arm + rng.normal(0, 2, arm.shape), 0, 255).astype(np.uint8)
    share = hand[..., 3:].astype(float) / 255
    over = canvas[:height].astype(float)
    canvas[:height, :, :3] = (share * hand[..., :3] + (1 - share) * over[..., :3]).astype(np.uint8)
    canvas[:height, :, 3:] = np.maximum(canvas[:height, :, 3:], hand[..., 3:])
    return canvas


def draw_gripper(rng: np.random.Generator) -> Image:
    """``(200, 200, 4)`` RGBA: a wrist from below and two jaws, of metal or plastic."""
    shape = np.zeros((4 * _SIDE, 4 * _SIDE), np.uint8)
    depth = np.zeros(shape.shape, np.float32)
    unit = 4 * _SIDE / 10
    gap, width = rng.uniform(1, 2.8), rng.uniform(0.4, 1.0)
    _box(shape, np.array([5 - gap - width, 6.2]) * unit, np.array([5 + gap + width, 7.6]) * unit)
    _box(shape, np.array([3.6, 7.4]) * unit, np.array([6.4, 10]) * unit)
    for side in (-1, 1):
        joint, tip = np.array([5 + side * gap, 6.5]), np.array([5 + side * gap * rng.uniform(0.6, 1), 1.5])
        _capsule(shape, depth, joint * unit, tip * unit, width * unit / 2)
    grey = rng.uniform(20, 230)
    colour = np.full(3, grey) if rng.random() < 0.6 else rng.uniform(20, 235, 3)
    return _coloured(shape, depth, colour, rng)


def cut_sign(photograph: Image, rng: np.random.Generator) -> Image:
    """``(200, 200, 4)`` RGBA: a post, a sign on a post or a bar, with colours of a photograph."""
    alpha = np.zeros((_SIDE, _SIDE), np.uint8)
    kind = rng.integers(3)
    middle, half = _SIDE // 2, int(rng.integers(3, 14))
    if kind == 0:
        alpha[:, middle - half : middle + half] = 255
    elif kind == 1:
        alpha[60:, middle - half // 3 - 2 : middle + half // 3 + 2] = 255
        side = int(rng.integers(20, 60))
        if rng.random() < 0.5:
            cv2.circle(alpha, (middle, 60), side, 255, -1)
        else:
            cv2.rectangle(alpha, (middle - side, 60 - side), (middle + side, 60 + side), 255, -1)
    else:
        alpha[middle - half : middle + half] = 255
    side = int(min(photograph.shape[:2]) * rng.uniform(0.2, 0.6))
    top, left = (int(rng.integers(0, size - side + 1)) for size in photograph.shape[:2])
    texture = cv2.resize(photograph[top : top + side, left : left + side], (_SIDE, _SIDE))
    if rng.random() < 0.5:
        texture = (0.25 * texture + 0.75 * rng.uniform(0, 255, 3)).astype(np.uint8)
    return np.dstack([texture, alpha])


def _pixel(at: NDArray[np.float64]) -> tuple[int, int]:
    return round(at[0]), round(at[1])


def _capsule(
    shape: Image,
    depth: NDArray[np.float32],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    radius: float,
) -> None:
    """Draw a limb and its darker edge."""
    cv2.line(shape, _pixel(start), _pixel(end), 255, int(2 * radius))
    cv2.line(depth, _pixel(start), _pixel(end), 0.72, int(2 * radius))
    cv2.line(depth, _pixel(start), _pixel(end), 1.0, max(int(1.5 * radius), 1))


def _box(shape: Image, corner: NDArray[np.float64], other: NDArray[np.float64]) -> None:
    cv2.rectangle(shape, _pixel(corner), _pixel(other), 255, -1)


def _coloured(
    shape: Image, depth: NDArray[np.float32], colour: NDArray[np.float64], rng: np.random.Generator
) -> Image:
    alpha = cv2.resize(shape, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    relief = np.where(depth > 0, depth, 1.0).astype(np.float32)
    relief = cv2.GaussianBlur(cv2.resize(relief, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA), (0, 0), 3)
    inner = np.minimum(cv2.distanceTransform((alpha > 127).astype(np.uint8), cv2.DIST_L2, 3) / 14, 1)
    slope = rng.normal(0, 0.25, 2)
    y, x = np.mgrid[-1 : 1 : _SIDE * 1j, -1 : 1 : _SIDE * 1j]
    light = (0.7 + 0.3 * inner) * relief * (1 + slope[0] * x + slope[1] * y)
    coarse = cv2.resize(rng.normal(0, 1, (25, 25)).astype(np.float32), (_SIDE, _SIDE))
    light = light + 0.04 * coarse + rng.normal(0, 0.02, light.shape)
    tint = colour * rng.uniform(0.85, 1.15) + rng.normal(0, 6, 3)
    return np.dstack([np.clip(light[..., None] * tint, 0, 255).astype(np.uint8), alpha])
