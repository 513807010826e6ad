"""Writes tiny data sets in the layouts of others; every image is 32 x 24 pixels."""

from __future__ import annotations

import json

import cv2
import numpy as np
from PIL import Image

WIDTH, HEIGHT = 32, 24


def rectangle(x, y, width, height):
    """``(H, W)`` bool."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[y : y + height, x : x + width] = True
    return mask


def write_frames(folder, names, suffix=".png"):
    """Images whose brightness tells their order: 10, 20, ..."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, name in enumerate(names, 1):
        cv2.imwrite(str(folder / f"{name}{suffix}"), np.full((HEIGHT, WIDTH, 3), 10 * n, np.uint8))


def write_grey(file, image):
    """A grey PNG: bool as 0 and 255, anything else as it is."""
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), image.astype(np.uint8) * 255 if image.dtype == bool else image)


def write_palette(file, labels):
    """A palette PNG as DAVIS has them: the colours say nothing of the labels."""
    file.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(labels.astype(np.uint8)).convert("P")
    image.putdata(labels.astype(np.uint8).ravel().tolist())
    image.putpalette([(37 * n + 128) % 256 for n in range(768)])
    image.save(file)


def write_lines(file, *lines):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")


def write_json(file, document):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(document))
