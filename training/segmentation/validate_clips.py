"""Real clips, never trained on: ``python training/segmentation/validate_clips.py CLIPS WHAT [options]``.

WHAT is ``network FILE.onnx``, ``track FILE.onnx``, ``grabcut``, ``u2netp FILE.onnx`` or ``sam FOLDER``. All but
``track`` segment the box of the true mask in the first frame, and in a few more frames, each on its own; ``track``
starts from the first box and goes on through the clip. CLIPS has folders with ``masks/`` and ``frames/`` or a video.
Prints the IoU with the true masks, by clip.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from predictor import Predictor
from teacher import GRID, SIDE, Teacher
from tracking3d.frames import Box, Image
from tracking3d.trackers.crops import box_of
from tracking3d.trackers.first_mask import mask_in_box
from tracking3d.trackers.onnx.description import SaliencyNetwork, load_segmenter_description
from tracking3d.trackers.onnx.saliency import SaliencySegmenter

Segment = Callable[[Image, Box], NDArray[np.float32]]

_FRAMES = 8
"""Frames of a clip that are segmented each on its own, beside the first."""

_VIDEOS = {"cube_whole": ("cube_in_hand/full_video.mp4", 150)}
"""Clips whose frames are a part of another's video, from this one on."""


def main(clips: Path, what: str, model: Path | None) -> None:
    """Print a table."""
    print(f"{'clip':20s} {'first':>6s} {'others':>7s}  frames")
    firsts, others = [], []
    for folder in sorted(folder for folder in clips.iterdir() if (folder / "masks").is_dir()):
        masks = _masks(folder)
        if what == "track":
            assert model is not None
            found = _track(folder, masks, Predictor(model))
        else:
            found = _alone(folder, masks, _segmenter(what, model))
        first = found.pop(min(found)) if min(found) == min(masks) else float("nan")
        rest = float(np.mean(list(found.values()))) if found else float("nan")
        print(f"{folder.name:20s} {first:6.3f} {rest:7.3f}  {len(found)}", flush=True)
        firsts.append(first)
        others.append(rest)
    print(f"{'mean':20s} {np.nanmean(firsts):6.3f} {np.nanmean(others):7.3f}")


def _segmenter(what: str, model: Path | None) -> Segment:
    if what == "grabcut":
        return mask_in_box
    assert model is not None, "give the network's file"
    if what == "network":
        predictor = Predictor(model)
        return predictor.first
    if what == "u2netp":
        description = load_segmenter_description("u2netp")
        assert isinstance(description, SaliencyNetwork)
        saliency = SaliencySegmenter(model, description, (1.2,), 1)
        return lambda image, box: saliency.propose(image, box, None)[0].mask
    if what == "sam":
        return _teacher_segmenter(Teacher(model, 1))
    raise SystemExit(f"There is no {what}; give network, track, grabcut, u2netp or sam.")


def _teacher_segmenter(teacher: Teacher) -> Segment:
    def segment(image: Image, box: Box) -> NDArray[np.float32]:
        teacher.look(image)
        answer = teacher.ask(tuple(value * teacher.scale for value in box))
        side = max(image.shape[:2])
        logits = cv2.resize(answer.logits, (side, side), interpolation=cv2.INTER_LINEAR)
        assert SIDE % GRID == 0
        return (logits[: image.shape[0], : image.shape[1]] > 0).astype(np.float32)

    return segment


def _alone(folder: Path, masks: dict[int, Path], segment: Segment) -> dict[int, float]:
    chosen = {min(masks), *np.random.default_rng(0).permutation(sorted(masks))[:_FRAMES].tolist()}
    found = {}
    for number, image in _frames(folder):
        if number > max(chosen):
            break
        if number in chosen and (box := box_of(truth := _mask(masks[number]))) is not None:
            given = _first_box(folder) if number == _start(folder) else None
            found[number] = _iou(segment(image, given or box) > 0.5, truth > 0.5)
    return found


def _track(folder: Path, masks: dict[int, Path], predictor: Predictor) -> dict[int, float]:
    found: dict[int, float] = {}
    begun = False
    for number, image in _frames(folder):
        if number < _start(folder) or number > max(masks):
            continue
        if begun:
            mask, _ = predictor.next(image)
        else:
            box = _first_box(folder) or box_of(_mask(masks[number]))
            assert box is not None
            mask, begun = predictor.first(image, box), True
        if number in masks:
            found[number] = _iou(mask > 0.5, _mask(masks[number]) > 0.5)
    return found


def _masks(folder: Path) -> dict[int, Path]:
    return {int(file.stem): file for file in sorted((folder / "masks").glob("*.png"))}


def _mask(file: Path) -> NDArray[np.float32]:
    return cv2.imread(str(file), cv2.IMREAD_GRAYSCALE).astype(np.float32) / 255


def _start(folder: Path) -> int:
    file = folder / "init.json"
    return int(json.loads(file.read_text(encoding="utf-8"))["frame"]) if file.exists() else 0


def _first_box(folder: Path) -> Box | None:
    file = folder / "init.json"
    if not file.exists():
        return None
    x, y, width, height = map(float, json.loads(file.read_text(encoding="utf-8"))["bbox_xywh"])
    return x, y, width, height


def _frames(folder: Path) -> Iterator[tuple[int, Image]]:
    files = sorted((folder / "frames").glob("*.*"))
    for file in files:
        yield int(file.stem), cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
    if files:
        return
    name, _ = _VIDEOS.get(folder.name, ("", 0))
    video = cv2.VideoCapture(str(folder.parent / name if name else folder / "video.mp4"))
    number = 0
    while True:
        there, image = video.read()
        if not there:
            return
        yield number, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        number += 1


def _iou(one: NDArray[np.bool_], two: NDArray[np.bool_]) -> float:
    union = np.count_nonzero(one | two)
    return np.count_nonzero(one & two) / union if union else 1.0


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        raise SystemExit("Usage: validate_clips.py CLIPS network|track|grabcut|u2netp|sam [MODEL]")
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]) if len(sys.argv) == 4 else None)
