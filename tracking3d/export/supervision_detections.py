"""Estimates of a run as `supervision.Detections`, to draw, filter and write them with that library."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from tracking3d.results.run_reader import RunReader

if TYPE_CHECKING:
    from supervision import Detections


def detections(run: RunReader, index: int) -> Detections:
    """The object in one frame: mask, box, confidence, and its pose in ``data["T_cam_obj"]`` ``(1, 4, 4)``.

    Needs the extra ``supervision``. Boxes are x and y of the first pixel's corner and of the last one's, as that
    library makes them from masks. Class and tracker id are 0. Without an estimate, or with an empty mask, there are
    no detections.

    Raises:
        InputError: If the mask of the frame is missing.
    """
    from supervision import Detections

    record = next((one for one in run.frames if one.index == index), None)
    if record is None:
        return Detections.empty()
    mask = run.mask(index)
    if not mask.any():
        return Detections.empty()
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return Detections(
        xyxy=np.array([[x, y, x + width - 1, y + height - 1]], dtype=float),
        mask=mask[None],
        confidence=np.array([record.confidence]),
        class_id=np.zeros(1, int),
        tracker_id=np.zeros(1, int),
        data={"T_cam_obj": record.T_cam_obj[None], "status": np.array([str(record.status)])},
    )
