"""The teacher: MobileSAM in two ONNX files, asked with points and boxes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

SIDE = 1024
"""Side of the encoder's input; boxes and points are in its pixels."""

GRID = 256
"""Side of the decoder's masks, which cover the whole input."""

_MEAN = (123.675, 116.28, 103.53)


@dataclass(frozen=True, eq=False)
class Answer:
    """One mask of the teacher.

    Attributes:
        logits: ``(GRID, GRID)`` float32.
        quality: The IoU that the teacher expects of it.
    """

    logits: NDArray[np.float32]
    quality: float

    @property
    def mask(self) -> NDArray[np.bool_]:
        """``(GRID, GRID)``."""
        return self.logits > 0

    @property
    def stability(self) -> float:
        """IoU of the masks at a higher and at a lower threshold."""
        return float(np.count_nonzero(self.logits > 1) / max(np.count_nonzero(self.logits > -1), 1))

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Its box ``(x, y, w, h)`` in pixels of the input."""
        columns, rows = np.flatnonzero(self.mask.any(0)), np.flatnonzero(self.mask.any(1))
        scale = SIDE / GRID
        return (
            scale * columns[0],
            scale * rows[0],
            scale * (columns[-1] + 1 - columns[0]),
            scale * (rows[-1] + 1 - rows[0]),
        )


class Teacher:
    """Asks for masks of one image after another.

    Args:
        folder: Where ``mobile_sam_encoder.onnx`` and ``mobile_sam_decoder.onnx`` lie.
        threads: CPU threads.
    """

    def __init__(self, folder: Path, threads: int) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        self._encoder, self._decoder = (
            onnxruntime.InferenceSession(str(folder / f"mobile_sam_{part}.onnx"), options)
            for part in ("encoder", "decoder")
        )
        self._embedding: NDArray[np.float32] | None = None
        self.scale = 1.0
        """Pixels of the input in a pixel of the image."""

    def look(self, image: NDArray[np.uint8]) -> None:
        """Take an RGB image ``(H, W, 3)``, the next to be asked about."""
        height, width = image.shape[:2]
        self.scale = SIDE / max(height, width)
        size = round(width * self.scale), round(height * self.scale)
        canvas = np.empty((SIDE, SIDE, 3), np.float32)
        canvas[:] = _MEAN
        canvas[: size[1], : size[0]] = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
        feed = {self._encoder.get_inputs()[0].name: canvas.transpose(2, 0, 1)[None]}
        self._embedding = self._encoder.run(None, feed)[0]

    def ask(
        self,
        box: tuple[float, float, float, float] | None = None,
        points: NDArray[np.float64] | None = None,
        labels: NDArray[np.int64] | None = None,
    ) -> Answer:
        """Ask for the mask in a box, or at points, or both; all in pixels of the input.

        Args:
            box: ``(x, y, w, h)``.
            points: ``(N, 2)``.
            labels: ``(N,)``, 1 for the object and 0 for the background; all 1 if left out.
        """
        coordinates = np.zeros((0, 2)) if points is None else np.asarray(points, float)
        kinds = np.ones(len(coordinates)) if labels is None else np.asarray(labels, float)
        if box is None:  # the network wants a padding point where there is no box
            coordinates, kinds = np.vstack([coordinates, [[0, 0]]]), np.append(kinds, -1)
        else:
            x, y, width, height = box
            coordinates = np.vstack([coordinates, [[x, y], [x + width, y + height]]])
            kinds = np.append(kinds, [2, 3])
        feed = {
            "image_embeddings": self._embedding,
            "point_coords": coordinates[None].astype(np.float32),
            "point_labels": kinds[None].astype(np.float32),
            "mask_input": np.zeros((1, 1, GRID, GRID), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
            "orig_im_size": np.array([8, 8], np.float32),
        }
        logits, quality = self._decoder.run(["low_res_masks", "iou_predictions"], feed)
        return Answer(logits[0, 0], float(quality.ravel()[0]))


def mask_iou(one: NDArray[np.bool_], two: NDArray[np.bool_]) -> float:
    """Intersection over union; 0 if both are empty."""
    return float(np.count_nonzero(one & two) / max(np.count_nonzero(one | two), 1))
