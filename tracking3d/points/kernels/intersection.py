"""Triangulates points one by one from the views that see them; see `tracking3d.points.robust_bundle.intersect`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import REORDER, kernel


@kernel(
    "void(float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64, float64,"
    " float64, int64, float64[:,::1], int64, int64)",
    fastmath=REORDER,
)
def intersect(
    points: NDArray[Any],
    intrinsics: NDArray[Any],
    T_cam_obj: NDArray[Any],
    measured: NDArray[Any],
    certain: NDArray[Any],
    held: float,
    outlier: float,
    nearest: float,
    turns: int,
    weight: NDArray[Any],
    first: int,
    last: int,
) -> None:
    """Move ``points`` ``(N, 3)`` from ``first`` to before ``last``, and fill the weights ``(N, T)`` of the last turn.

    Args:
        points: Where they begin; written to.
        intrinsics: ``(T, 4)``.
        T_cam_obj: ``(T, 4, 4)``.
        measured: ``(N, T, 2)`` pixels.
        certain: ``(N, T)`` inverse variance of the measurements; 0 if there is none.
        held: Deviation of the points' movement, in object units.
        outlier: Deviations at which a measurement has a quarter of its weight.
        nearest: Depth from which on points have an image.
        turns: Steps.
        weight: Written to.
        first, last: Points.
    """
    hold = 1 / (held * held)
    gradient = np.empty((2, 3))
    for n in range(first, last):
        X, Y, Z = points[n]
        x0, y0, z0 = X, Y, Z
        for _ in range(turns):
            hxx, hxy, hxz, hyy, hyz, hzz = hold, 0.0, 0.0, hold, 0.0, hold
            bx, by, bz = hold * (x0 - X), hold * (y0 - Y), hold * (z0 - Z)
            for t in range(len(T_cam_obj)):
                weight[n, t] = 0.0
                if certain[n, t] == 0.0:
                    continue
                T = T_cam_obj[t]
                depth = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * Z + T[2, 3]
                if not depth > nearest:
                    continue
                over = 1 / depth
                x = (T[0, 0] * X + T[0, 1] * Y + T[0, 2] * Z + T[0, 3]) * over
                y = (T[1, 0] * X + T[1, 1] * Y + T[1, 2] * Z + T[1, 3]) * over
                fx, fy = intrinsics[t, 0], intrinsics[t, 1]
                left_x = measured[n, t, 0] - fx * x - intrinsics[t, 2]
                left_y = measured[n, t, 1] - fy * y - intrinsics[t, 3]
                far = certain[n, t] * (left_x * left_x + left_y * left_y) / (outlier * outlier)
                w = certain[n, t] / ((1 + far) * (1 + far))
                weight[n, t] = w
                for k in range(3):
                    gradient[0, k] = fx * over * (T[0, k] - x * T[2, k])
                    gradient[1, k] = fy * over * (T[1, k] - y * T[2, k])
                for i, left in ((0, left_x), (1, left_y)):
                    a, b, c = gradient[i, 0], gradient[i, 1], gradient[i, 2]
                    hxx += w * a * a
                    hxy += w * a * b
                    hxz += w * a * c
                    hyy += w * b * b
                    hyz += w * b * c
                    hzz += w * c * c
                    bx += w * a * left
                    by += w * b * left
                    bz += w * c * left
            cxx, cxy, cxz = hyy * hzz - hyz * hyz, hxz * hyz - hxy * hzz, hxy * hyz - hxz * hyy
            cyy, cyz, czz = hxx * hzz - hxz * hxz, hxy * hxz - hxx * hyz, hxx * hyy - hxy * hxy
            over = 1 / (hxx * cxx + hxy * cxy + hxz * cxz)
            X += over * (cxx * bx + cxy * by + cxz * bz)
            Y += over * (cxy * bx + cyy * by + cyz * bz)
            Z += over * (cxz * bx + cyz * by + czz * bz)
        points[n, 0], points[n, 1], points[n, 2] = X, Y, Z
