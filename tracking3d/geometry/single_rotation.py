"""One rotation that nobody differentiates through, converted with plain numbers.

A solver converts thousands of single poses a second, and most of kornia's time for one goes into some thirty small
tensors. The same sums and products in the same order and precision give the same digits.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_FLOOR = 1e-8  # of what a root is taken of


def is_single(values: Tensor, dimensions: int) -> bool:
    """Whether this is one rotation on the CPU that takes no part in a gradient."""
    return (
        values.ndim == dimensions
        and values.device.type == "cpu"
        and values.dtype in (torch.float32, torch.float64)
        and not (values.requires_grad and torch.is_grad_enabled())
    )


def matrix_of(quaternion: Tensor) -> Tensor:
    """``(3, 3)`` of ``(4,)``, w first, of any length; the identity if that is 0."""
    values = quaternion.detach()
    length = torch.linalg.vector_norm(values).numpy()
    if length != 0:  # NaN is passed on
        w, x, y, z = values.numpy() / max(length, length.dtype.type(1e-12))
    else:
        w, x, y, z = values.numpy()
    tx, ty, tz = x + x, y + y, z + z
    twx, twy, twz = tx * w, ty * w, tz * w
    txx, txy, txz = tx * x, ty * x, tz * x
    tyy, tyz, tzz = ty * y, tz * y, tz * z
    one = x.dtype.type(1)
    rows = [
        [one - (tyy + tzz), txy - twz, txz + twy],
        [txy + twz, one - (txx + tzz), tyz - twx],
        [txz - twy, tyz + twx, one - (txx + tyy)],
    ]
    return torch.from_numpy(np.array(rows, x.dtype))


def quaternion_of(R: Tensor) -> Tensor:
    """``(4,)``, w first, of ``(3, 3)``."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = R.detach().numpy()
    one, quarter = m00.dtype.type(1), m00.dtype.type(0.25)
    trace = m00 + m11 + m22
    if trace > 0:
        root = _twice_root(trace + one)
        quaternion = quarter * root, *_over(root, m21 - m12, m02 - m20, m10 - m01)
    elif m00 > m11 and m00 > m22:
        root = _twice_root(one + m00 - m11 - m22)
        w, y, z = _over(root, m21 - m12, m01 + m10, m02 + m20)
        quaternion = w, quarter * root, y, z
    elif m11 > m22:
        root = _twice_root(one + m11 - m00 - m22)
        w, x, z = _over(root, m02 - m20, m01 + m10, m12 + m21)
        quaternion = w, x, quarter * root, z
    else:
        root = _twice_root(one + m22 - m00 - m11)
        w, x, y = _over(root, m10 - m01, m02 + m20, m12 + m21)
        quaternion = w, x, y, quarter * root
    return torch.from_numpy(np.array(quaternion, m00.dtype))


def _twice_root(value: np.floating) -> np.floating:
    """Twice the root, of no less than a small number; NaN of NaN."""
    of = value.dtype.type
    if value <= of(_FLOOR):
        return of(2 * _FLOOR**0.5)
    [root] = (
        torch.from_numpy(np.array([value])).sqrt().numpy()
    )  # NumPy's differs from torch's in the last digit
    return of(2) * root


def _over(divisor: np.floating, *values: np.floating) -> list[np.floating]:
    return [value / divisor for value in values]
