"""Draw the teacher's masks: ``python training/segmentation/contact_sheet.py PHOTOS MASKS OUT.png [COUNT [SEED]]``."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

_TILE = 240


def main(photos: Path, masks: Path, picture: Path, count: int, seed: int) -> None:
    """Draw ``count`` random photographs with their masks, in rows of six."""
    files = [file for file in sorted(masks.glob("*/*.npz")) if not file.name.endswith(".part.npz")]
    chosen = np.random.default_rng(seed).permutation(len(files))[:count]
    tiles = [_tile(photos, files[index]) for index in chosen]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 6)
    rows = [np.hstack(tiles[start : start + 6]) for start in range(0, len(tiles), 6)]
    cv2.imwrite(str(picture), np.vstack(rows))


def _tile(photos: Path, file: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(photos / file.parent.name / f"{file.stem}.jpg"))
    side = max(image.shape[:2])
    with np.load(file) as data:
        logits = data["logits"]
    colours = np.random.default_rng(1).integers(60, 255, (32, 3))
    drawn = image.copy()
    for mask, colour in zip(logits, colours, strict=False):
        grid = cv2.resize(mask.astype(np.float32), (side, side))[: image.shape[0], : image.shape[1]]
        drawn[grid > 0] = (0.5 * drawn[grid > 0] + 0.5 * colour).astype(np.uint8)
        outlines, _ = cv2.findContours((grid > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(drawn, outlines, -1, [int(value) for value in colour], 2)
    tile = np.zeros((_TILE, _TILE, 3), np.uint8)
    small = cv2.resize(drawn, None, fx=_TILE / side, fy=_TILE / side, interpolation=cv2.INTER_AREA)[
        :_TILE, :_TILE
    ]
    tile[: small.shape[0], : small.shape[1]] = small
    return tile


if __name__ == "__main__":
    if not 4 <= len(sys.argv) <= 6:
        raise SystemExit(
            "Usage: python training/segmentation/contact_sheet.py PHOTOS MASKS PICTURE.png [COUNT [SEED]]"
        )
    numbers = [*map(int, sys.argv[4:]), 30, 0][: max(2, len(sys.argv) - 4)]
    main(*map(Path, sys.argv[1:4]), numbers[0], numbers[1] if len(sys.argv) == 6 else 0)
