"""From stored samples to the network's input: crops, mirrored and recoloured, some channels left out."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from network import CHANNELS
from scene_sequences import CANVAS, PLANES

CROP = 1.4
"""Side of the crop in longer sides of the box."""

_BOX_JITTER = 0.1
_BACKGROUND = {"object": 0, "occluder": 0, "carried": 0, "colours": 128, "motion": 128}
"""What lies beyond a stored sample, by its planes."""

Float = NDArray[np.float32]
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Given:
    """Which of the channels beside RGB a sample has; the box in place of the carried mask if ``box``."""

    box: bool
    colours: bool
    motion: bool


@dataclass(frozen=True, eq=False)
class Batch:
    """Inputs ``(B, 8, S, S)``, targets ``(B, 2, S, S)`` in [0, 1], and whether the occluder is known, ``(B,)``."""

    inputs: Float
    targets: Float
    knows_occluder: Float


class SamplePool:
    """The stored samples of some files; `refresh` takes up those that were added."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder, self._name = folder, name
        self._files: dict[Path, tuple[NDArray[np.uint8], list[tuple[str, bool]]]] = {}
        self.refresh()

    def refresh(self) -> None:
        """Look for new files."""
        for file in sorted(self._folder.glob(f"{self._name}_????.npy")):
            if file in self._files:
                continue
            with file.with_suffix(".csv").open(encoding="utf-8") as stream:
                rows = [(row["kind"], row["knows_occluder"] == "1") for row in csv.DictReader(stream)]
            self._files[file] = np.load(file, mmap_mode="r"), rows

    def __len__(self) -> int:
        return sum(len(rows) for _, rows in self._files.values())

    def sample(self, index: int) -> tuple[NDArray[np.uint8], str, bool]:
        """``(8, CANVAS, CANVAS)``, its kind, and whether its occluder is known."""
        for samples, rows in self._files.values():
            if index < len(rows):
                return np.asarray(samples[index]), *rows[index]
            index -= len(rows)
        raise IndexError("there are fewer samples")


def box_of(mask: NDArray[np.uint8]) -> Box:
    """Of the pixels over 127, ``(x, y, w, h)``; the middle if there are none."""
    x, y, width, height = cv2.boundingRect((mask > 127).astype(np.uint8))
    return (x, y, width, height) if width else (CANVAS / 4, CANVAS / 4, CANVAS / 2, CANVAS / 2)


def jittered(box: Box, rng: np.random.Generator, most: float = _BOX_JITTER) -> Box:
    """With each side off by up to ``most`` of the box."""
    x, y, width, height = box
    amount = most * rng.random()
    left, right = rng.uniform(-amount, amount, 2) * width
    top, bottom = rng.uniform(-amount, amount, 2) * height
    return (x + left, y + top, max(width - left + right, 4), max(height - top + bottom, 4))


def network_input(
    planes: dict[str, NDArray], box: Box, given: Given, size: int
) -> tuple[Float, NDArray[np.float64]]:
    """``(8, size, size)``, and the affine map from the stored sample to the crop.

    Args:
        planes: ``(H, W)`` uint8 by name, all of `PLANES` that are there.
        box: The box that the crop is taken around, and that is drawn if ``given.box``.
        given: What the network is told.
        size: Side of the crop.
    """
    x, y, width, height = box
    scale = size / (CROP * max(width, height))
    matrix = np.array(
        [[scale, 0, size / 2 - scale * (x + width / 2)], [0, scale, size / 2 - scale * (y + height / 2)]]
    )
    channels = np.zeros((len(CHANNELS), size, size), np.float32)
    for index, name in enumerate(("red", "green", "blue")):
        channels[index] = _crop(planes[name], matrix, size, None) / np.float32(255) - np.float32(0.5)
    if given.box:
        corners = [(matrix @ (px, py, 1)) for px, py in ((x, y), (x + width, y + height))]
        (left, top), (right, bottom) = (np.clip(np.round(corner).astype(int), 0, size) for corner in corners)
        channels[3, top:bottom, left:right] = 1
        channels[6] = 1
    else:
        channels[3] = _crop(planes["carried"], matrix, size, 0) / np.float32(255)
    if given.colours:
        channels[4] = (_crop(planes["colours"], matrix, size, 128) - np.float32(128)) / np.float32(127)
        channels[7] = 1
    if given.motion:
        channels[5] = (_crop(planes["motion"], matrix, size, 128) - np.float32(128)) / np.float32(127)
    return channels, matrix


def _crop(plane: NDArray, matrix: NDArray[np.float64], size: int, beyond: int | None) -> Float:
    border = cv2.BORDER_REPLICATE if beyond is None else cv2.BORDER_CONSTANT
    small = matrix[0, 0] < 0.7
    crop = cv2.warpAffine(
        cv2.blur(plane, (2, 2)) if small else plane, matrix, (size, size),
        flags=cv2.INTER_LINEAR, borderMode=border, borderValue=beyond or 0,
    )  # fmt: skip
    return crop.astype(np.float32)


def make_batch(
    pool: SamplePool, indices: NDArray[np.int64], draw: tuple[float, float, float], size: int, seed: list[int]
) -> Batch:
    """Crops of stored samples.

    Args:
        pool: The samples.
        indices: Which.
        draw: Shares of boxes, of colours and of motion among the others.
        size: Side of the crops.
        seed: Of all that is random.
    """
    rng = np.random.default_rng(seed)
    inputs, targets, known = [], [], []
    for index in indices:
        sample, _, knows = pool.sample(int(index))
        if rng.random() < 0.5:
            sample = sample[:, :, ::-1]
        if rng.random() < 0.15:
            sample = sample.transpose(0, 2, 1)[:, ::-1]
        planes = {name: np.ascontiguousarray(plane) for name, plane in zip(PLANES, sample, strict=True)}
        box_only = rng.random() < draw[0]
        share = 0.1 if box_only else 1.0
        given = Given(box_only, rng.random() < share * draw[1], rng.random() < share * draw[2])
        box = jittered(box_of(planes["object" if box_only else "carried"]), rng)
        crop, matrix = network_input(planes, box, given, size)
        crop[:3] = _recoloured(crop[:3], rng)
        inputs.append(crop)
        targets.append([_crop(planes[name], matrix, size, 0) / 255 for name in ("object", "occluder")])
        known.append(knows)
    return Batch(np.stack(inputs), np.array(targets, np.float32), np.array(known, np.float32))


def _recoloured(crop: Float, rng: np.random.Generator) -> Float:
    contrast, shift = np.float32(np.exp(rng.normal(0, 0.15))), np.float32(rng.normal(0, 0.05))
    tint = rng.normal(0, 0.03, (3, 1, 1)).astype(np.float32)
    if rng.random() < 0.05:
        crop = np.broadcast_to(crop.mean(0), crop.shape)
    return np.clip(crop * contrast + (shift + tint), np.float32(-0.5), np.float32(0.5))
