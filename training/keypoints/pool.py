"""Pairs of crops with points known to be the same in both, and the teacher's opinion of each crop.

``python training/keypoints/pool.py PHOTOGRAPHS TEACHER.onnx POOL.npz [PAIRS]``
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "s2dnet"))
import rendered
from pairs import CANVAS, apply_homography, make_canvas, random_homography
from photographs import find_cutouts, find_photographs
from photometry import disturb
from tracking3d.features.networks.session import Network

SIZE = 128  # side of a crop in pixels
POINTS = 128  # most points of a pair
PAIRS = 5000  # warped ones, and as many rendered ones
CHANNELS = 32  # of the descriptors to which the teacher's are reduced
_SEED = 66_000  # no object of the suites has a seed so high
_OF_OBJECT = 12  # pairs of an object: five frames, ordered
_RENDER = 224  # side of a rendered frame in pixels, as long as objects are where keypoints are looked for
_STRENGTH = 0.6  # most of the photometric change
_FRAMES = (0, 2, 5, 10, 16)
FOLDERS = (
    "gnome-backgrounds", "lomiri-wallpapers-16.04", "lomiri-wallpapers-20.04", "mate-backgrounds",
    "plasma-workspace-wallpapers", "ukui-wallpapers",
)  # fmt: skip

Image = NDArray[np.uint8]
Points = NDArray[np.float64]


def _textured(image: Image, count: int, rng: np.random.Generator, inside: NDArray[np.bool_]) -> Points:
    """``(N, 2)`` points: corners for one half, chance with a preference for texture for the other."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    mask = inside.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(grey, count // 2, 0.005, 4, mask=mask)
    rows, columns = np.nonzero(inside)
    texture = cv2.GaussianBlur(np.abs(cv2.Laplacian(grey, cv2.CV_32F)), (0, 0), 3)
    tries = rng.integers(len(rows), size=(count, 3))
    best = tries[np.arange(count), texture[rows[tries], columns[tries]].argmax(1)]
    chance = np.stack([columns[best], rows[best]], 1).astype(float)
    return np.concatenate([corners.reshape(-1, 2), chance]) if corners is not None else chance


def _warped(photographs: list[Image], cutouts: list[Image], rng: np.random.Generator):
    """A crop and another view of it under a homography."""
    side = int(CANVAS * SIZE)
    canvas = make_canvas(photographs, cutouts, side, rng)
    border = (side - SIZE) // 2
    plain = np.ascontiguousarray(canvas[border : border + SIZE, border : border + SIZE])
    H = random_homography(SIZE, rng, float(rng.uniform(0.2, 1)))
    shift = np.array([[1, 0, -border], [0, 1, -border], [0, 0, 1.0]])
    other = cv2.warpPerspective(canvas, H @ shift, (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT)
    points = _textured(plain, 2 * POINTS, rng, np.ones((SIZE, SIZE), bool))
    return plain, other, points, apply_homography(H, points)


def _render(index: int, photographs: list[Image], cutouts: list[Image]) -> rendered.RenderedObject:
    """An object in five frames, 6 to 70 degrees apart; three of four carry photographs."""
    rng = np.random.default_rng([_SEED, index])
    spec = rendered.SequenceSpec(
        object=rendered.OBJECTS[index % len(rendered.OBJECTS)],
        motion=("tumble", "turntable")[index // len(rendered.OBJECTS) % 2],
        degrees_per_frame=float(rng.uniform(2, 5)),
        frames=max(_FRAMES) + 1,
        size=(_RENDER, _RENDER),
        fill=float(rng.uniform(0.7, 0.9)),
        disturbances=rendered.Disturbances(light=1.0, highlights=float(rng.uniform(0, 0.6))),
        seed=_SEED + index,
    )
    scene = rendered.make_scene(spec)
    scene = replace(scene, background=rendered.linear(rendered._patch(photographs, (_RENDER, _RENDER), rng)))
    if index % 4 and scene.texture is not None:
        # Texture files of solids with faces are of six parts, each with its own picture then.
        height, width = (extent // parts for extent, parts in zip(scene.texture.shape, (2, 3), strict=False))
        tiles = [[make_canvas(photographs, cutouts, 256, rng) for _ in range(3)] for _ in range(2)]
        texture = np.vstack([np.hstack([cv2.resize(tile, (width, height)) for tile in row]) for row in tiles])
        scene = replace(scene, texture=rendered.linear(texture))
    frames = [rendered.render_frame(scene, frame) for frame in _FRAMES]
    return rendered.RenderedObject(frames, scene.T_cam_obj[list(_FRAMES)], scene.camera.K)


def _turned(item: rendered.RenderedObject, rng: np.random.Generator):
    """Crops of two frames of an object around one point of it, the second turned in its plane a little."""
    one, two = (int(frame) for frame in rng.choice(len(item.frames), 2, replace=False))
    first, second = item.frames[one], item.frames[two]
    if first.visible_mask.sum() < 500:
        return None
    pixels = np.rint(_textured(first.image, 3 * POINTS, rng, first.visible_mask)).astype(np.int64)
    target, seen = rendered.follow(item, one, two, pixels)
    if seen.sum() < 16:
        return None
    pixels, target = pixels[seen], target[seen]
    centre = int(rng.integers(len(pixels)))
    views = []
    for image, points, turn in ((first.image, pixels, 0.0), (second.image, target, rng.normal(0, 15))):
        warp = cv2.getRotationMatrix2D(
            tuple(map(float, points[centre])), turn, float(2 ** rng.uniform(-0.3, 0.2))
        )
        warp[:, 2] += SIZE / 2 + rng.uniform(-0.25, 0.25, 2) * SIZE - points[centre]
        views.append((cv2.warpAffine(image, warp, (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT),
                      np.column_stack([points, np.ones(len(points))]) @ warp.T))  # fmt: skip
    return views[0][0], views[1][0], views[0][1], views[1][1]


def make_pool(folder: Path, teacher: Path, file: Path, count: int) -> None:
    """Make ``count`` warped and ``count`` rendered pairs, ask the teacher about the undisturbed crops, and save all."""
    rng = np.random.default_rng(_SEED)
    photographs = find_photographs([folder / name for name in FOLDERS], 480, 1600)
    cutouts = find_cutouts([folder / "tuxpaint-stamps-default"], 120, 400)
    network = Network(teacher, 1)
    images = np.zeros((2 * count, 2, SIZE, SIZE), np.uint8)
    points = np.full((2 * count, 2, POINTS, 2), np.nan, np.float32)
    scores = np.zeros((2 * count, 2, SIZE, SIZE), np.float16)
    descriptors = np.zeros((2 * count, 2, CHANNELS, SIZE // 4, SIZE // 4), np.float16)
    item, axes, left, index = None, None, 0, 0
    waiting = []
    for number in range(2 * count):
        pair = None
        while pair is None:
            if number % 2 == 0:
                pair = _warped(photographs, cutouts, rng)
            else:
                if item is None:
                    item, left, index = _render(index, photographs, cutouts), _OF_OBJECT, index + 1
                pair = _turned(item, rng)
                left -= 1
                if pair is None or not left:
                    item = None
        inside = np.all([(p > 2) & (p < SIZE - 3) for p in pair[2:]], (0, 2))
        chosen = rng.permutation(np.flatnonzero(inside))[:POINTS]
        for side in (0, 1):
            image = disturb(pair[side], rng, float(rng.uniform(0, _STRENGTH)))
            images[number, side] = np.rint(255 * cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            points[number, side, : len(chosen)] = pair[2 + side][chosen]
            clean = cv2.cvtColor(pair[side], cv2.COLOR_RGB2GRAY).astype(np.float32)[None, None] / 255
            answer = network.run({"x": clean})
            scores[number, side] = answer["score"][0, 0]
            full = answer["desc"][0] / np.linalg.norm(answer["desc"][0], axis=0)
            if axes is None:
                waiting.append((number, side, full))
            else:
                descriptors[number, side] = np.tensordot(axes, full, 1)
        if axes is None and number == min(200, 2 * count - 1):
            # The directions that keep most of the dot products: the similarities of the teacher in half the length.
            vectors = np.concatenate([full.reshape(len(full), -1) for *_, full in waiting], 1)
            value, vector = np.linalg.eigh(vectors @ vectors.T)
            axes = vector[:, ::-1][:, :CHANNELS].T
            print(
                f"{value[::-1][:CHANNELS].sum() / value.sum():.3f} of the teacher's length is kept",
                flush=True,
            )
            for where, side, full in waiting:
                descriptors[where, side] = np.tensordot(axes, full, 1)
        if number % 500 == 0:
            print(number, "pairs", flush=True)
    np.savez(file, images=images, points=points, scores=scores, descriptors=descriptors)


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5):
        raise SystemExit(__doc__)
    make_pool(*map(Path, sys.argv[1:4]), int(sys.argv[4]) if len(sys.argv) == 5 else PAIRS)
