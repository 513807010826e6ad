"""Find hands: ``python training/segmentation/hand_points.py PHOTOS MODULES OUT.csv``; needs ``ai-edge-litert``.

MODULES is the folder ``mediapipe/modules`` of the wheel mediapipe 0.10.14 (Apache-2.0): its palm detector proposes
hands, its landmark network says whether there is one, and where its 21 points lie. OUT.csv has a row for every hand:
the file below PHOTOS, the score, and x and y of the points in pixels. Files that are in it already are not read again.

Zhang et al., MediaPipe Hands, 2020.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Points = NDArray[np.float64]

_PALM_SIDE, _HAND_SIDE = 192, 224
_MIN_PALM, _MIN_HAND = 0.5, 0.7
_PALM_TO_HAND, _UP = 2.6, 0.5
"""A hand's square is so many times as large as its palm's box, and so many of that box's sides towards the fingers."""

_WRIST, _MIDDLE_FINGER = 0, 2
_MOST = 4


class Network:
    """A TFLite file."""

    def __init__(self, file: Path) -> None:
        from ai_edge_litert.interpreter import Interpreter

        self._network = Interpreter(str(file), num_threads=1)
        self._network.allocate_tensors()

    def run(self, image: Image) -> list[NDArray[np.float32]]:
        """Its outputs for an RGB image of the right size."""
        self._network.set_tensor(
            self._network.get_input_details()[0]["index"], image[None].astype(np.float32) / 255
        )
        self._network.invoke()
        return [self._network.get_tensor(output["index"])[0] for output in self._network.get_output_details()]


def main(photos: Path, modules: Path, out: Path) -> None:
    """Go over all photographs."""
    palm = Network(modules / "palm_detection" / "palm_detection_full.tflite")
    hand = Network(modules / "hand_landmark" / "hand_landmark_full.tflite")
    done = set()
    if out.exists():
        with out.open(encoding="utf-8") as stream:
            done = {row[0] for row in csv.reader(stream)}
    with out.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        for file in sorted(photos.glob("*/*.jpg")):
            name = f"{file.parent.name}/{file.name}"
            if name in done:
                continue
            image = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
            hands = find_hands(image, palm, hand)
            for score, points in hands:
                writer.writerow([name, f"{score:.3f}", *(f"{value:.1f}" for value in points.ravel())])
            if not hands:
                writer.writerow([name])
            stream.flush()


def find_hands(image: Image, palm: Network, hand: Network) -> list[tuple[float, Points]]:
    """Scores, and 21 points ``(21, 2)`` in pixels, of the hands in an RGB image."""
    found: list[tuple[float, Points]] = []
    for square in _squares(image, palm):
        onto = _affine(square, _HAND_SIDE)
        crop = cv2.warpAffine(image, onto, (_HAND_SIDE, _HAND_SIDE))
        landmarks, score = hand.run(crop)[:2]
        if float(score[0]) < _MIN_HAND:
            continue
        points = landmarks.reshape(21, 3)[:, :2].astype(np.float64)
        points = cv2.transform(points[None], cv2.invertAffineTransform(onto))[0]
        size = np.ptp(points, axis=0).max()
        if all(np.linalg.norm(points.mean(0) - other.mean(0)) > 0.4 * size for _, other in found):
            found.append((float(score[0]), points))
    return found


def _squares(image: Image, palm: Network) -> list[tuple[float, float, float, float]]:
    """Centre, side and angle of the squares in which there may be a hand, the likeliest first."""
    height, width = image.shape[:2]
    scale = _PALM_SIDE / max(height, width)
    canvas = np.zeros((_PALM_SIDE, _PALM_SIDE, 3), np.uint8)
    small = cv2.resize(image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    canvas[: small.shape[0], : small.shape[1]] = small
    boxes, logits = palm.run(canvas)
    scores = 1 / (1 + np.exp(-np.clip(logits[:, 0].astype(np.float64), -50, 50)))
    squares: list[tuple[float, float, float, float]] = []
    anchors = _anchors()
    for index in np.argsort(-scores):
        if scores[index] < _MIN_PALM or len(squares) == _MOST:
            break
        anchor, values = anchors[index], boxes[index].astype(np.float64)
        keypoints = (values[4:].reshape(7, 2) + anchor) / scale
        centre, side = (values[:2] + anchor) / scale, values[2:4].max() / scale
        along = keypoints[_MIDDLE_FINGER] - keypoints[_WRIST]
        along /= max(np.linalg.norm(along), 1e-6)
        centre = centre + _UP * side * along
        angle = float(np.arctan2(along[1], along[0]) + np.pi / 2)
        if all(np.hypot(*(centre - other[:2])) > 0.5 * side for other in squares):
            squares.append((float(centre[0]), float(centre[1]), _PALM_TO_HAND * side, angle))
    return squares


def _anchors() -> Points:
    """``(2016, 2)`` pixels of the detector's input: the cells of two grids, twice and six times each."""
    anchors = []
    for cells, times in ((24, 2), (12, 6)):
        y, x = np.mgrid[:cells, :cells]
        centres = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * _PALM_SIDE / cells
        anchors.append(np.repeat(centres, times, axis=0))
    return np.concatenate(anchors)


def _affine(square: tuple[float, float, float, float], side: int) -> Points:
    """``(2, 3)`` from the image to a crop in which the fingers point up."""
    x, y, length, angle = square
    scale = side / length
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    linear = np.array([[cosine, sine], [-sine, cosine]])
    return np.column_stack([linear, side / 2 - linear @ (x, y)])


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit("Usage: python training/segmentation/hand_points.py PHOTOS MODULES OUT.csv")
    main(*map(Path, sys.argv[1:]))
