"""BOP: errors of the pose of a known model, and average recall.

As ``bop_toolkit`` computes them for the BOP Challenge since 2019 (Hodan et al., "BOP Challenge 2020 on 6D object
localization", ECCVW 2020). Poses are ``(4, 4)`` ``T_cam_obj`` in OpenCV axes; lengths are in the unit of the poses.
An estimate without a true model comes in an object frame and unit of its own; carry its poses into the true ones
before (`tracking3d_bench.evaluation.alignment`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from tracking3d_bench.evaluation.arrays import finite, floats

Pose = NDArray[np.float64]
"""``(4, 4)`` rigid transform ``T_cam_obj``."""

THRESHOLDS = np.arange(0.05, 0.51, 0.05)
"""``(10,)`` errors under which a pose is right: of VSD as they are, of MSSD in object diameters."""

PIXEL_THRESHOLDS = np.arange(5.0, 51.0, 5.0)
"""``(10,)`` the same for MSPD, in pixels of an image 640 wide."""

IMAGE_WIDTH = 640


@dataclass(frozen=True)
class AverageRecall:
    """Share of right poses, averaged over the thresholds (and over the misalignment tolerances of VSD).

    Attributes:
        vsd, mssd, mspd: Recall of each error; None if it could not be computed.
    """

    vsd: float | None
    mssd: float | None
    mspd: float | None

    @property
    def mean(self) -> float | None:
        """AR, the figure of BOP's tables: the mean of the three; None unless all are known."""
        if self.vsd is None or self.mssd is None or self.mspd is None:
            return None
        return (self.vsd + self.mssd + self.mspd) / 3


def average_recall(
    vsd_errors: ArrayLike | None,
    mssd_errors: ArrayLike | None,
    mspd_errors: ArrayLike | None,
    diameter: float,
    image_width: int,
) -> AverageRecall:
    """Average recall over N frames. A frame without an estimate has infinite errors.

    Args:
        vsd_errors: ``(N, 10)`` by tolerance, of `tracking3d_bench.evaluation.vsd`; None if there is no depth.
        mssd_errors: ``(N,)`` in the unit of ``diameter``.
        mspd_errors: ``(N,)`` pixels.
        diameter: Diameter of the model.
        image_width: Pixels.

    Raises:
        ValueError: If a shape does not fit, or the diameter or width is not positive.
    """
    if not (0 < diameter < np.inf and image_width > 0):
        raise ValueError(f"the diameter {diameter} and the width {image_width} need to be positive")
    vsd = None if vsd_errors is None else floats("vsd_errors", vsd_errors, None, None)
    mssd = None if mssd_errors is None else floats("mssd_errors", mssd_errors, None) / diameter
    mspd = (
        None if mspd_errors is None else floats("mspd_errors", mspd_errors, None) * IMAGE_WIDTH / image_width
    )
    return AverageRecall(_recall(vsd, THRESHOLDS), _recall(mssd, THRESHOLDS), _recall(mspd, PIXEL_THRESHOLDS))


def mssd(T_est: Pose, T_true: Pose, points: ArrayLike, symmetries: ArrayLike | None = None) -> float:
    """Maximum symmetry-aware surface distance: largest distance of a model point, least over the symmetries.

    Args:
        T_est, T_true: ``(4, 4)``.
        points: ``(P, 3)`` vertices of the model.
        symmetries: ``(S, 4, 4)`` object transforms that leave it as it is, the identity among them; None for none.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    model = _points(points)
    estimated = _transform(_pose("T_est", T_est), model)
    return min(
        float(np.linalg.norm(estimated - _transform(T, model), axis=1).max())
        for T in _equivalent_poses(T_true, symmetries)
    )


def mspd(
    T_est: Pose, T_true: Pose, K: ArrayLike, points: ArrayLike, symmetries: ArrayLike | None = None
) -> float:
    """Maximum symmetry-aware projection distance, in pixels; infinite if a point lies in the camera's plane.

    Args:
        T_est, T_true: ``(4, 4)``.
        K: ``(3, 3)`` intrinsics of the full frame.
        points: ``(P, 3)`` vertices of the model.
        symmetries: As of `mssd`.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    model, intrinsics = _points(points), finite("K", K, 3, 3)
    estimated = _project(intrinsics, _transform(_pose("T_est", T_est), model))
    distances = [
        np.linalg.norm(estimated - _project(intrinsics, _transform(T, model)), axis=1).max()
        for T in _equivalent_poses(T_true, symmetries)
    ]
    return float(np.nan_to_num(distances, nan=np.inf, posinf=np.inf).min())


def add(T_est: Pose, T_true: Pose, points: ArrayLike) -> float:
    """Average distance of the model points ``(P, 3)`` (Hinterstoisser et al., ACCV 2012).

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    model = _points(points)
    moved = _transform(_pose("T_est", T_est), model) - _transform(_pose("T_true", T_true), model)
    return float(np.linalg.norm(moved, axis=1).mean())


def adi(T_est: Pose, T_true: Pose, points: ArrayLike) -> float:
    """ADD-S: average distance of each model point ``(P, 3)`` at the true pose to the nearest at the estimated one.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    model = _points(points)
    nearest = cKDTree(_transform(_pose("T_est", T_est), model))
    return float(nearest.query(_transform(_pose("T_true", T_true), model))[0].mean())


def rotation_error(T_est: Pose, T_true: Pose) -> float:
    """``re``: angle between the rotations, in degrees.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    relative = _pose("T_est", T_est)[:3, :3] @ _pose("T_true", T_true)[:3, :3].T
    return float(np.degrees(Rotation.from_matrix(relative).magnitude()))


def translation_error(T_est: Pose, T_true: Pose) -> float:
    """``te``: distance of the translations.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    return float(np.linalg.norm(_pose("T_est", T_est)[:3, 3] - _pose("T_true", T_true)[:3, 3]))


def model_diameter(points: ArrayLike) -> float:
    """Largest distance between two of the points ``(P, 3)``, which must not lie in one plane.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    model = _points(points)
    return float(pdist(model[ConvexHull(model).vertices]).max())


def _recall(errors: NDArray[np.float64] | None, thresholds: NDArray[np.float64]) -> float | None:
    if errors is None or not errors.size:
        return None
    return float(np.mean(errors[..., None] < thresholds))


def _pose(name: str, T: Pose) -> Pose:
    return finite(name, T, 4, 4)


def _points(points: ArrayLike) -> NDArray[np.float64]:
    model = finite("points", points, None, 3)
    if not len(model):
        raise ValueError("points needs shape (P, 3) with P > 0, got (0, 3)")
    return model


def _equivalent_poses(T_true: Pose, symmetries: ArrayLike | None) -> NDArray[np.float64]:
    """``(S, 4, 4)`` true poses that cannot be distinguished."""
    same = np.eye(4)[None] if symmetries is None else finite("symmetries", symmetries, None, 4, 4)
    if not len(same):
        raise ValueError("symmetries needs shape (S, 4, 4) with S > 0, got (0, 4, 4)")
    return _pose("T_true", T_true) @ same


def _transform(T: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points @ T[:3, :3].T + T[:3, 3]


def _project(K: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    homogeneous = points @ K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[:, :2] / homogeneous[:, 2:]
