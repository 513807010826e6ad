"""The visible RGB texture as an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering import BackProjection


def visible_texture(seen: BackProjection) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """RGB texture ``(T, T, 3)`` and how much each texel was seen ``(T, T)``.

    Texels that were never seen continue their neighbours smoothly; their weight stays zero.
    """
    weight = seen.weight.cpu().numpy()
    values = seen.mean().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).cpu().numpy()
    unseen = (weight <= 0).astype(np.uint8)
    if not unseen.any() or unseen.all():
        return values, weight
    # Repeating a margin on both sides lets the inpainting wrap around in u.
    margin = values.shape[1] // 8
    padded = np.concatenate([values[:, -margin:], values, values[:, :margin]], 1)
    holes = np.concatenate([unseen[:, -margin:], unseen, unseen[:, :margin]], 1)
    filled = cv2.inpaint(padded, holes, 3, cv2.INPAINT_TELEA)
    return np.ascontiguousarray(filled[:, margin:-margin]), weight
