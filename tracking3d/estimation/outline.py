"""The outline of a window's mask as a distance, honest at the border of the frame."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from tracking3d.rendering import signed_distance


def outline_distance(mask: Tensor, valid: Tensor) -> Tensor:
    """``(S, S)`` signed distance in pixels to the mask's outline, negative inside, zero beyond the frame's border.

    A mask that the border cuts off goes on beyond it: the cut is no outline of the object.

    Args:
        mask: ``(S, S)`` in [0, 1].
        valid: ``(S, S)`` 1 inside the frame, 0 beyond its border.
    """
    inside = valid > 0.5
    if bool(inside.all()) or not bool(inside.any()):
        return signed_distance(mask[None])[0]
    _, nearest = distance_transform_edt(~inside.cpu().numpy(), return_indices=True)
    row, column = (torch.from_numpy(np.ascontiguousarray(axis)).to(mask.device) for axis in nearest)
    return torch.where(inside, signed_distance(mask[row.long(), column.long()][None])[0], 0.0)
