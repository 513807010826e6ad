"""Composed scenes: cut-outs that move on a photograph, with hands, grippers, signs and shadows in front."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gaps import with_gaps
from layers import Motion, alpha_of, paste, placed, shadow_of, smeared, warp
from occluders import cut_sign, draw_gripper, draw_hand, with_arm
from photometry import Camera, light_over, plain_backdrop
from scene_sequences import CANVAS, OBJECT, Frame, Scene, background_frames

Image = NDArray[np.uint8]
Map = NDArray[np.float32]
Matrix = NDArray[np.float64]

_TURNS = Motion(shift=7, turn=6, scale=0.05, bend=0.05)
_RESTS = Motion(shift=0.4, turn=0.3, scale=0.004, bend=0.002)
_LONG_AGO = Motion(shift=6, turn=25, scale=0.1, bend=0.08)
_GAPS = 0.25
"""Share of the cut-outs that get gaps."""

_PLAIN = 0.12
"""Share of the scenes before a plain backdrop."""

_FILLED = 21
"""Gaps up to so many pixels are what a tracker may take for the object."""

_MIN_COVER = 0.03
"""Share of the object that something has to hide to count as being in front of it."""


@dataclass(frozen=True, eq=False)
class Material:
    """What scenes are made of.

    Attributes:
        photographs: ``(H, W, 3)`` RGB each.
        objects: Cut-outs ``(h, w, 4)``.
        hands: Cut-outs of real hands; drawn ones are used, too.
    """

    photographs: Sequence[Image]
    objects: Sequence[Image]
    hands: Sequence[Image]


@dataclass(frozen=True, eq=False)
class _Actor:
    """A layer with its homographies in the three frames; ``label`` is object, hand, thing (in front) or distractor."""

    layer: Image
    matrices: list[Matrix]
    label: str
    late_layer: Image | None = None


def composed_scene(material: Material, rng: np.random.Generator) -> Scene:
    """A random scene."""
    plain = rng.random() < _PLAIN
    photograph = plain_backdrop(CANVAS, rng) if plain else _pick(material.photographs, rng)
    backgrounds, camera_motion = background_frames(photograph, rng.random() < 0.4, rng)
    still = rng.random() < 0.25
    object_ = _object(material, camera_motion if still else None, rng)
    actors = [object_]
    behind = [_distractor(material, camera_motion, rng) for _ in range(int(rng.integers(0, 3)))]
    kind = str(rng.choice(["none", "hand", "gripper", "sign", "thing"], p=[0.25, 0.42, 0.1, 0.1, 0.13]))
    if kind in ("hand", "gripper"):
        held = rng.random() < 0.6
        behind_too, front = _holder(material, kind, object_ if held else None, rng)
        behind += [behind_too] if behind_too is not None else []
        actors.append(front)
    elif kind == "sign":
        layer = cut_sign(_pick(material.photographs, rng), rng)
        actors.append(_in_front(layer, camera_motion, "thing", rng))
    elif kind == "thing":
        moves = None if rng.random() < 0.5 else camera_motion
        actors.append(_in_front(_cut_out(material, rng), moves, "thing", rng))
    light = [light_over(CANVAS, rng, 0.15)] * 3
    shadow = (
        rng.normal(0, 14),
        abs(rng.normal(0, 10)),
        rng.uniform(1, 9),
        rng.choice([0, rng.uniform(0.1, 0.6)]),
    )
    camera = Camera.draw(rng)
    frames = [_render(backgrounds[i], [*behind, *actors], i, light[i], shadow, camera, rng) for i in range(3)]
    return Scene(*frames, kind=kind, knows_occluder=True)


def _pick(items: Sequence[Image], rng: np.random.Generator) -> Image:
    return items[int(rng.integers(len(items)))]


def _cut_out(material: Material, rng: np.random.Generator) -> Image:
    layer = _pick(material.objects, rng)
    return with_gaps(layer, rng) if rng.random() < _GAPS else layer


def _path(
    start: Matrix, motion: Motion, rng: np.random.Generator, fixed: list[Matrix] | None = None
) -> list[Matrix]:
    """Homographies of a layer in the three frames that end at ``start``; ``fixed`` are the background's motions."""
    if fixed is not None:
        return [step @ start for step in fixed]
    centre = (CANVAS / 2, CANVAS / 2)
    last = motion.draw(centre, rng) @ start
    return [_LONG_AGO.draw(centre, rng) @ last, last, start]


def _object(material: Material, fixed: list[Matrix] | None, rng: np.random.Generator) -> _Actor:
    layer = _varied(_cut_out(material, rng), material, rng)
    centre = tuple(CANVAS / 2 + rng.uniform(-0.1, 0.1, 2) * OBJECT)
    start = placed(layer, OBJECT * rng.uniform(0.9, 1.1), centre, rng.normal(0, 30), rng.random() < 0.5)
    motion = _RESTS if rng.random() < 0.2 else _TURNS
    late = _turned(layer, material, rng) if fixed is None and rng.random() < 0.3 else None
    return _Actor(layer, _path(start, motion, rng, fixed), "object", late)


def _varied(layer: Image, material: Material, rng: np.random.Generator) -> Image:
    """Sometimes in other colours, plain white or dark, or with a photograph on it."""
    choice = rng.random()
    if choice < 0.6:
        return layer
    alpha, grey = layer[..., 3:], cv2.cvtColor(layer[..., :3].copy(), cv2.COLOR_RGB2GRAY)[..., None] / 255.0
    if choice < 0.75:
        colours = layer[..., rng.permutation(3)]
    elif choice < 0.87:  # plain, with its shading
        tint = np.full(3, rng.choice([235, 25, 140])) + rng.normal(0, 15, 3)
        shading = 1 + 0.6 * (grey - grey[alpha[..., 0] > 127].mean() if (alpha > 127).any() else 0)
        colours = np.clip(tint * shading, 0, 255)
    else:
        texture = cv2.resize(_pick(material.photographs, rng), (layer.shape[1], layer.shape[0]))
        colours = np.clip(texture * (0.55 + 0.7 * grey), 0, 255)
    return np.dstack([colours.astype(np.uint8), alpha])


def _turned(layer: Image, material: Material, rng: np.random.Generator) -> Image:
    """The same outline after a turn: its old side squeezed to one edge, another side beside it."""
    height, width = layer.shape[:2]
    shown = rng.uniform(0.25, 0.85)
    edge = max(int(shown * width), 2)
    old = cv2.resize(layer[..., :3], (edge, height), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.5:  # a plain side in one of its own colours
        row, column = (int(rng.integers(size)) for size in (height, width))
        other = np.full((height, width - edge, 3), layer[row, column, :3]) * rng.uniform(0.6, 1.2)
    else:
        other = cv2.resize(_pick(material.photographs, rng), (max(width - edge, 1), height))
    colours = np.hstack([old, np.clip(other, 0, 255).astype(np.uint8)])[:, :width]
    if rng.random() < 0.5:
        colours = colours[:, ::-1]
    return np.dstack([colours, layer[..., 3]])


def _distractor(material: Material, fixed: list[Matrix], rng: np.random.Generator) -> _Actor:
    """Another thing beside the object, behind it, that stays with the background."""
    layer = _cut_out(material, rng)
    angle, away = rng.uniform(0, 2 * np.pi), OBJECT * rng.uniform(0.45, 1.0)
    centre = (CANVAS / 2 + away * np.cos(angle), CANVAS / 2 + away * np.sin(angle))
    start = placed(layer, OBJECT * rng.uniform(0.4, 1.3), centre, rng.normal(0, 30), rng.random() < 0.5)
    return _Actor(layer, _path(start, _TURNS, rng, fixed if rng.random() < 0.8 else None), "distractor")


def _holder(
    material: Material, kind: str, held: _Actor | None, rng: np.random.Generator
) -> tuple[_Actor | None, _Actor]:
    """A hand or gripper from beyond the border: what of it is behind the object, if any, and what is in front."""
    if kind == "gripper":
        layer = draw_gripper(rng)
    elif material.hands and rng.random() < 0.85:
        layer = _pick(material.hands, rng)
        if rng.random() < 0.8:
            layer = with_arm(layer, _pick(material.photographs, rng), rng)
    else:
        layer = draw_hand(rng)
    turn = rng.uniform(0, 360)
    longest = OBJECT * rng.uniform(0.9, 2.0)
    reach = rng.uniform(0.25, 0.6) * longest
    angle = np.radians(turn + 90)
    centre = (
        CANVAS / 2 + reach * np.cos(angle) + rng.normal(0, 12),
        CANVAS / 2 + reach * np.sin(angle) + rng.normal(0, 12),
    )
    start = placed(layer, longest, centre, turn, rng.random() < 0.5)
    if held is not None:  # it moves as the object does
        steps = [matrix @ np.linalg.inv(held.matrices[2]) for matrix in held.matrices]
        matrices = [step @ start for step in steps]
    else:
        matrices = _path(start, _TURNS, rng)
    label = "hand"
    if kind == "hand" and rng.random() < 0.5:  # the object lies in the hand: only some fingers are in front
        front, split = layer.copy(), rng.uniform(0.2, 0.6)
        front[int(split * layer.shape[0]) :, :, 3] = 0
        if rng.random() < 0.5:
            side = int(rng.uniform(0.3, 0.7) * layer.shape[1])
            front[:, :side, 3] = 0
        return _Actor(layer, matrices, label), _Actor(front, matrices, label)
    return None, _Actor(layer, matrices, label)


def _in_front(layer: Image, fixed: list[Matrix] | None, label: str, rng: np.random.Generator) -> _Actor:
    angle, away = rng.uniform(0, 2 * np.pi), OBJECT * rng.uniform(0.1, 0.6)
    centre = (CANVAS / 2 + away * np.cos(angle), CANVAS / 2 + away * np.sin(angle))
    start = placed(layer, OBJECT * rng.uniform(0.5, 2.2), centre, rng.normal(0, 25), rng.random() < 0.5)
    return _Actor(layer, _path(start, _TURNS, rng, fixed), label)


def _render(
    background: NDArray[np.float32],
    actors: list[_Actor],
    index: int,
    light: Map,
    shadow: tuple[float, float, float, float],
    camera: Camera,
    rng: np.random.Generator,
) -> Frame:
    frame, whole = background, None
    visible = np.zeros((CANVAS, CANVAS), np.float32)
    in_front, confusing = visible.copy(), []
    for actor in actors:
        source = actor.late_layer if actor.late_layer is not None and index == 2 else actor.layer
        layer = warp(source, actor.matrices[index], CANVAS)
        if index:
            here, before = (
                actor.matrices[i] @ (source.shape[1] / 2, source.shape[0] / 2, 1) for i in (index, index - 1)
            )
            speed = np.clip(here[:2] / here[2] - before[:2] / before[2], -12, 12)
            layer = smeared(layer, *(0.4 * speed)) if index == 2 else layer
        alpha = alpha_of(layer)
        if shadow[3]:
            factors = shadow_of(alpha, *shadow)
            frame = frame * factors[..., None]
            if actor.label == "object":
                confusing.append((1 - alpha) * (factors < 1 - 0.5 * shadow[3]))
        frame = paste(frame, layer)
        visible = visible * (1 - alpha)
        in_front = in_front * (1 - alpha)
        if actor.label == "object":
            visible, whole = alpha.copy(), alpha
            filled = cv2.morphologyEx(alpha, cv2.MORPH_CLOSE, np.ones((_FILLED, _FILLED), np.uint8))
            if (filled - alpha).sum() > _MIN_COVER * alpha.sum():
                confusing.append(filled)
        elif actor.label == "hand":
            in_front = np.maximum(in_front, alpha)
            confusing.append(alpha)
        elif actor.label == "thing" and whole is not None:
            covered = float((alpha * whole).sum() / max(whole.sum(), 1))
            if covered >= _MIN_COVER:
                in_front = np.maximum(in_front, alpha)
            confusing.append(alpha)
    picture = camera.take(frame * light[..., None], rng)
    return Frame(picture, visible, in_front, [mask.astype(np.float32) for mask in confusing])
