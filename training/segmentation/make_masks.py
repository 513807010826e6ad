"""Ask the teacher about photographs: ``python training/segmentation/make_masks.py PHOTOS MODELS OUT [THREADS [N/M]]``.

Writes ``OUT/SOURCE/KEY.npz`` for every photograph, also where nothing sure was found; goes on where it was stopped.
With ``0/2`` and ``1/2`` two processes share the work. A file has ``logits`` ``(K, 256, 256)`` int8, eight times the
teacher's, on the square of the photograph's longer side from its upper left corner; ``boxes`` ``(K, 4)`` in the
photograph's pixels (x, y, w, h); ``quality`` and ``stability`` ``(K,)``.
"""

from __future__ import annotations

import csv
import sys
import time
from itertools import zip_longest
from pathlib import Path

import cv2
import numpy as np

from split import held_out
from teacher import GRID, SIDE, Answer, Teacher, mask_iou

LOGIT_SCALE = 8
_MIN_QUALITY, _MIN_STABILITY = 0.86, 0.88
_MIN_AGREEMENT = 0.85
"""IoU of the masks from a point and from the box of that mask; of a box and of the box of its mask."""

_SAME = 0.7
_AREA = (0.006, 0.6)
_MIN_CONNECTED = 0.9
_POINTS = 4
_MOST = 10
_DEPTH = 3
"""So many folders of a photograph's path tell one kind from another."""

_FIRST_HELD_OUT = 130
"""So many photographs that are kept for validation come first."""


def main(photos: Path, models: Path, out: Path, threads: int, part: int, parts: int) -> None:
    """Go over the photographs, first some of those held out, then one of every folder of every source in turn."""
    order = _in_turn(photos)
    teacher = Teacher(models, threads)
    start, done, found = time.monotonic(), 0, 0
    for file in order[part::parts]:
        target = out / file.parent.name / f"{file.stem}.npz"
        if target.exists():
            continue
        image = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        teacher.look(image)
        answers = find_objects(teacher, image.shape[:2], np.random.default_rng(int(file.stem, 16)))
        write(target, answers, teacher.scale)
        done, found = done + 1, found + len(answers)
        if done % 20 == 0:
            print(
                f"{done} photographs, {found} masks, {(time.monotonic() - start) / done:.2f} s each",
                flush=True,
            )


def _in_turn(photos: Path) -> list[Path]:
    folders: dict[tuple[str, ...], list[Path]] = {}
    with (photos / "index.csv").open(encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            if row["teach"] == "yes":
                source = row["file"].split("/")[0]
                inside = row["path in its source"].split("/")[:-1][:_DEPTH]
                folders.setdefault((source, *inside), []).append(photos / row["file"])
    for files in folders.values():
        np.random.default_rng(0).shuffle(files)
    order = [file for files in zip_longest(*folders.values()) for file in files if file is not None]
    kept = held_out(photos)
    apart = [file for file in order if f"{file.parent.name}/{file.name}" in kept]
    return apart[:_FIRST_HELD_OUT] + order


def find_objects(teacher: Teacher, shape: tuple[int, int], rng: np.random.Generator) -> list[Answer]:
    """Masks of the image that the teacher looks at which a point and a box agree on, the surest first."""
    height, width = (side * teacher.scale for side in shape)
    answers: list[Answer] = []
    for share in (0.55, 0.85):
        box = ((1 - share) / 2 * width, (1 - share) / 2 * height, share * width, share * height)
        _consider(teacher, teacher.ask(box), (height, width), answers)
    steps = (np.mgrid[:_POINTS, :_POINTS].reshape(2, -1).T + rng.uniform(0.2, 0.8, (_POINTS**2, 2))) / _POINTS
    for y, x in rng.permutation(steps):
        at = int(y * height * GRID / SIDE), int(x * width * GRID / SIDE)
        if len(answers) == _MOST:
            break
        if not any(answer.mask[at] for answer in answers):
            _consider(
                teacher, teacher.ask(points=np.array([[x * width, y * height]])), (height, width), answers
            )
    return sorted(answers, key=lambda answer: -answer.quality)


def _consider(teacher: Teacher, first: Answer, shape: tuple[float, float], answers: list[Answer]) -> None:
    """Ask again with the box of a mask, and add the answer if it is sure, and new."""
    if not _AREA[0] < first.mask.mean() * SIDE**2 / (shape[0] * shape[1]) < _AREA[1]:
        return
    answer = teacher.ask(first.box)
    if min(answer.quality, answer.stability) < min(_MIN_QUALITY, _MIN_STABILITY) or not answer.mask.any():
        return
    agree = mask_iou(first.mask, answer.mask) >= _MIN_AGREEMENT
    if not agree or answer.quality < _MIN_QUALITY or answer.stability < _MIN_STABILITY:
        return
    if not _is_compact(answer) or _touched_borders(answer, shape) > 2:
        return
    if all(mask_iou(answer.mask, other.mask) < _SAME for other in answers):
        answers.append(answer)


def _is_compact(answer: Answer) -> bool:
    _, _, stats, _ = cv2.connectedComponentsWithStats(answer.mask.astype(np.uint8))
    areas = stats[1:, cv2.CC_STAT_AREA]
    return bool(areas.max() >= _MIN_CONNECTED * areas.sum())


def _touched_borders(answer: Answer, shape: tuple[float, float]) -> int:
    x, y, width, height = answer.box
    edge = 2 * SIDE / GRID
    return sum((x < edge, y < edge, x + width > shape[1] - edge, y + height > shape[0] - edge))


def write(target: Path, answers: list[Answer], scale: float) -> None:
    """Write the masks of one photograph, whole or not at all."""
    target.parent.mkdir(parents=True, exist_ok=True)
    logits = np.array([answer.logits for answer in answers], np.float32).reshape(-1, GRID, GRID)
    values = {
        "logits": np.clip(np.round(LOGIT_SCALE * logits), -127, 127).astype(np.int8),
        "boxes": np.array([answer.box for answer in answers], np.float32).reshape(-1, 4) / scale,
        "quality": np.array([answer.quality for answer in answers], np.float32),
        "stability": np.array([answer.stability for answer in answers], np.float32),
    }
    part = target.with_name(f"{target.stem}.part.npz")
    np.savez_compressed(part, **values)
    part.replace(target)


if __name__ == "__main__":
    if not 4 <= len(sys.argv) <= 6:
        raise SystemExit(
            "Usage: python training/segmentation/make_masks.py PHOTOS MODELS OUT [THREADS [N/M]]"
        )
    number, count = (sys.argv[5:] or ["0/1"])[0].split("/")
    threads = int((sys.argv[4:] or ["1"])[0])
    main(*map(Path, sys.argv[1:4]), threads, int(number), int(count))
