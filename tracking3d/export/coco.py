"""Masks in COCO's format: one JSON file, each mask run-length encoded, column by column.

Run lengths are written as numbers (COCO's uncompressed RLE), which `pycocotools` and what is built on it read like the
compressed ones. An image is a frame; one without an object in it has no annotation. https://cocodataset.org/#format-data
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.export.exported_run import ExportedRun


def write_coco(run: ExportedRun, path: Path) -> None:
    """Write images, annotations and the one category ``object``; numbers of images are frame indices."""
    height, width = run.camera.height, run.camera.width
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for index, record in run.records.items():
        name = record.name if "." in record.name else f"{index:06d}.jpg"
        images.append({"id": index, "file_name": name, "width": width, "height": height})
        mask = run.mask(index)
        if mask.any():
            score = record.confidence if math.isfinite(record.confidence) else 0.0
            annotations.append(_annotation(len(annotations) + 1, index, mask, score))
    document = {
        "info": {"description": f"tracking3d run {run.name}"},
        "images": images,
        "categories": [{"id": 1, "name": "object", "supercategory": "object"}],
        "annotations": annotations,
    }
    path.write_text(json.dumps(document) + "\n", encoding="utf-8")


def run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """Lengths of runs of 0 and 1 in turn, 0 first, column by column of ``mask`` ``(H, W)``."""
    pixels = mask.ravel(order="F")
    changes = np.flatnonzero(np.diff(pixels, prepend=False))
    lengths: list[int] = np.diff(changes, prepend=0, append=len(pixels)).tolist()
    return lengths


def _annotation(number: int, index: int, mask: NDArray[np.bool_], score: float) -> dict[str, Any]:
    return {
        "id": number,
        "image_id": index,
        "category_id": 1,
        "segmentation": {"size": list(mask.shape), "counts": run_lengths(mask)},
        "bbox": list(cv2.boundingRect(mask.astype(np.uint8))),
        "area": int(np.count_nonzero(mask)),
        "iscrowd": 0,
        "score": score,
    }
