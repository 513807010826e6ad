"""Masks of hands: ``python training/segmentation/make_hands.py PHOTOS POINTS.csv MODELS MASKS CUTOUTS [THREADS]``.

POINTS.csv comes from ``hand_points.py``. For every photograph with hands the teacher is asked for each hand's mask at
its points; ``MASKS/SOURCE/KEY.npz`` is of the kind that ``make_masks.py`` writes, and ``CUTOUTS/KEY_N.png`` is the hand
cut out, RGBA, its fingers up. Goes on where it was stopped; cut-outs that are missing are made from the masks.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cutouts import Masked, cut_out, read_masked
from make_masks import write
from teacher import GRID, SIDE, Answer, Teacher

_ASKED = (0, 1, 2, 4, 5, 7, 8, 9, 12, 13, 16, 17, 20)
"""Of the 21 points, those that are shown to the teacher: wrist, thumb, knuckles, finger tips."""

_MIN_QUALITY, _MIN_STABILITY, _MIN_COVERED = 0.82, 0.85, 0.85
_LARGEST = 4.5
"""Area of the mask in those of the points' box: a whole person is no hand."""

_CUTOUT = 220
_WRIST, _MIDDLE_KNUCKLE = 0, 9


def main(photos: Path, points: Path, models: Path, masks: Path, cutouts: Path, threads: int) -> None:
    """Ask about all hands."""
    cutouts.mkdir(parents=True, exist_ok=True)
    teacher, found = Teacher(models, threads), 0
    for number, (name, hands) in enumerate(_hands(points).items()):
        target = masks / name.replace(".jpg", ".npz")
        if not (photos / name).exists():
            continue
        if not target.exists():
            image = cv2.cvtColor(cv2.imread(str(photos / name)), cv2.COLOR_BGR2RGB)
            teacher.look(image)
            answers = [answer for hand in hands if (answer := ask_hand(teacher, hand)) is not None]
            write(target, answers, teacher.scale)
            found += len(answers)
            if number % 20 == 0:
                print(f"{number} photographs, {found} hands", flush=True)
        for index, item in enumerate(read_masked(photos, target)):
            file = cutouts / f"{target.stem}_{index}.png"
            if not file.exists():
                cv2.imwrite(str(file), cv2.cvtColor(cut_hand(item, hands), cv2.COLOR_RGBA2BGRA))


def cut_hand(item: Masked, hands: list[NDArray[np.float64]]) -> NDArray[np.uint8]:
    """The hand cut out, turned so that its fingers point up, with its wrist at the lower border: RGBA."""
    points = max(hands, key=lambda hand: _covered(item, hand))
    along = points[_MIDDLE_KNUCKLE] - points[_WRIST]
    angle = float(np.arctan2(along[1], along[0]) + np.pi / 2)
    cutout = cut_out(item, _CUTOUT)
    side = int(1.5 * max(cutout.shape[:2]))
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    middle = np.array(cutout.shape[1::-1]) / 2
    matrix = np.column_stack([turn, side / 2 - turn @ middle])
    turned = cv2.warpAffine(cutout, matrix, (side, side), flags=cv2.INTER_LINEAR)
    x, y, width, height = cv2.boundingRect((turned[..., 3] > 100).astype(np.uint8))
    return turned[y : y + height, x : x + width]


def _covered(item: Masked, points: NDArray[np.float64]) -> float:
    columns, rows = np.clip(points.astype(int), 0, np.array(item.soft.shape[::-1]) - 1).T
    return float(item.soft[rows, columns].mean())


def _hands(points: Path) -> dict[str, list[NDArray[np.float64]]]:
    hands: dict[str, list[NDArray[np.float64]]] = {}
    with points.open(encoding="utf-8") as stream:
        for row in csv.reader(stream):
            if len(row) > 2:
                hands.setdefault(row[0], []).append(np.array(row[2:], float).reshape(21, 2))
    return hands


def ask_hand(teacher: Teacher, points: NDArray[np.float64]) -> Answer | None:
    """The mask of the hand with these points ``(21, 2)`` in the image's pixels; None if the teacher is not sure."""
    points = points * teacher.scale
    low, high = points.min(0), points.max(0)
    margin = 0.12 * (high - low).max()
    box = (*(low - margin), *(high - low + 2 * margin))
    for answer in (teacher.ask(points=points[list(_ASKED)]), teacher.ask(box, points[list(_ASKED)])):
        if answer.quality < _MIN_QUALITY or answer.stability < _MIN_STABILITY or not answer.mask.any():
            continue
        cells = np.clip((points * GRID / SIDE).astype(int), 0, GRID - 1)
        covered = answer.mask[cells[:, 1], cells[:, 0]].mean()
        area = answer.mask.sum() * (SIDE / GRID) ** 2 / (box[2] * box[3])
        if covered >= _MIN_COVERED and area < _LARGEST:
            return answer
    return None


if __name__ == "__main__":
    if len(sys.argv) not in (6, 7):
        raise SystemExit("Usage: make_hands.py PHOTOS POINTS.csv MODELS MASKS CUTOUTS [THREADS]")
    main(*map(Path, sys.argv[1:6]), int((sys.argv[6:] or ["1"])[0]))
