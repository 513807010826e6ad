"""What is left of translations, and of one frame's pose, after the alignment of the object frames.

See `tracking3d.geometry.alignment`, which holds the alignment of a whole clip.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.alignment import ObjectAlignment, Poses, split_poses
from tracking3d.geometry.alignment import align_object_frame as align_object_frame
from tracking3d_bench.evaluation.arrays import finite


def align_on_frame(
    T_est: NDArray[np.float64], T_true: NDArray[np.float64], scale: float | None = None
) -> ObjectAlignment:
    """The similarity under which one frame agrees exactly, which makes all other frames drift against it.

    Args:
        T_est: ``(4, 4)`` estimated pose of that frame.
        T_true: ``(4, 4)``.
        scale: Length of the estimate's unit in that of the truth; from `align_object_frame` over all frames, say.
            None takes the ratio of the two depths of this frame.

    Raises:
        ValueError: If a shape is another, a value is not finite, or the scale is not positive.
    """
    (R_est,), (t_est,) = split_poses("T_est", np.asarray(T_est)[None])
    (R_true,), (t_true,) = split_poses("T_true", np.asarray(T_true)[None])
    if scale is None and not t_est[2] * t_true[2] > 0:
        raise ValueError(f"depths {t_est[2]} and {t_true[2]} give no scale")
    scale = float(t_true[2] / t_est[2]) if scale is None else scale
    if not 0 < scale < np.inf:
        raise ValueError(f"the scale needs to be positive, got {scale}")
    return ObjectAlignment(R_est.T @ R_true, scale, R_est.T @ (t_true / scale - t_est))


def translation_errors(
    T_est: Poses, T_true: Poses, alignment: ObjectAlignment, diameter: float | None = None
) -> NDArray[np.float64]:
    """Distance ``(N,)`` of the aligned translation from the true one, in object diameters.

    Args:
        T_est: ``(N, 4, 4)`` estimates as they are.
        T_true: ``(N, 4, 4)``.
        alignment: Alignment of these poses.
        diameter: Diameter of the object in the truth's unit. None measures in median true depths of these frames.

    Raises:
        ValueError: If the shapes differ, a value is not finite, or the unit is not positive.
    """
    residuals = _translation_residuals(alignment, T_est, T_true)
    unit = float(np.median(T_true[:, 2, 3])) if diameter is None and len(T_true) else diameter
    if unit is not None and not 0 < unit < np.inf:
        raise ValueError(f"the unit of translation errors needs to be positive, got {unit}")
    return residuals / (unit or 1.0)


def _translation_residuals(alignment: ObjectAlignment, T_est: Poses, T_true: Poses) -> NDArray[np.float64]:
    t_true = finite("T_true", T_true, len(T_est), 4, 4)[:, :3, 3]
    return np.linalg.norm(alignment.poses(T_est)[:, :3, 3] - t_true, axis=1)
