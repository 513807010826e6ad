"""BOP's visible surface discrepancy: how far two poses of a model differ in what a depth camera would see.

As ``bop_toolkit`` computes it for the BOP Challenge since 2019: step cost, tolerances of 0.05 to 0.5 diameters, and
the visibility of 2019, which counts pixels without depth as seen (Hodan et al., "BOP: benchmark for 6D object pose
estimation", ECCV 2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d_bench.evaluation.arrays import finite, floats

TOLERANCES = np.arange(0.05, 0.51, 0.05)
"""``(10,)`` tau: misalignments in object diameters below which a pixel agrees."""

VISIBILITY_TOLERANCE = 15.0
"""Delta in millimetres: how far behind the measured surface a pixel of the model still counts as seen."""


def vsd(
    depth_est: ArrayLike,
    depth_true: ArrayLike,
    depth_test: ArrayLike,
    K: ArrayLike,
    delta: float,
    diameter: float,
    tolerances: ArrayLike = TOLERANCES,
) -> NDArray[np.float64]:
    """Errors ``(10,)`` in [0, 1], one for each tolerance; 1 where the model is seen at neither pose.

    Share of the pixels where either pose shows the model that differ: where only one does, or where the distances
    to the camera differ by the tolerance or more.

    Args:
        depth_est: ``(H, W)`` z of the model at the estimated pose, of `model_depth`; 0 where it is not.
        depth_true: The same at the true pose.
        depth_test: ``(H, W)`` measured z of the scene; 0 where it is unknown.
        K: ``(3, 3)`` intrinsics of the full frame.
        delta: `VISIBILITY_TOLERANCE` in the unit of the depths.
        diameter: Diameter of the model.
        tolerances: In diameters.

    Raises:
        ValueError: If a shape does not fit, a depth is not finite, or the diameter is not positive.
    """
    if not 0 < diameter < np.inf:
        raise ValueError(f"the diameter needs to be positive, got {diameter}")
    test = depth_to_distance(depth_test, K)
    estimated = depth_to_distance(floats("depth_est", depth_est, *test.shape), K)
    true = depth_to_distance(floats("depth_true", depth_true, *test.shape), K)

    seen_true = _visible_pixels(true, test, delta)
    # What is seen at the true pose and covered at the estimated one counts as seen there too.
    seen_est = _visible_pixels(estimated, test, delta) | (seen_true & (estimated > 0))
    both = seen_true & seen_est
    either = np.count_nonzero(seen_true | seen_est)
    limits = floats("tolerances", tolerances, None)
    if not either:
        return np.ones(len(limits))
    misaligned = np.abs(true[both] - estimated[both]) / diameter
    differing = np.count_nonzero(misaligned >= limits[:, None], axis=1)
    return (differing + either - np.count_nonzero(both)) / either


def depth_to_distance(depth: ArrayLike, K: ArrayLike) -> NDArray[np.float64]:
    """Distances ``(H, W)`` from the camera's centre of the points with z ``depth``, pixel centres at integers.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    z, intrinsics = finite("depth", depth, None, None), finite("K", K, 3, 3)
    y, x = np.ogrid[: z.shape[0], : z.shape[1]]
    ray_x = (x - intrinsics[0, 2]) / intrinsics[0, 0]
    ray_y = (y - intrinsics[1, 2]) / intrinsics[1, 1]
    return z * np.sqrt(ray_x**2 + ray_y**2 + 1)


def model_depth(
    vertices: ArrayLike, faces: ArrayLike, T_cam_obj: ArrayLike, K: ArrayLike, size: tuple[int, int]
) -> NDArray[np.float64]:
    """Depth ``(H, W)`` of a model at a pose, 0 where it is not.

    Faces are drawn from both sides, as BOP does for models whose surface is not closed. Faces that reach behind the
    camera are not drawn.

    Args:
        vertices: ``(V, 3)`` in the unit of the poses.
        faces: ``(F, 3)``.
        T_cam_obj: ``(4, 4)``.
        K: ``(3, 3)`` intrinsics of the full frame.
        size: Width and height of the frame.

    Raises:
        ValueError: If a shape does not fit or a value is not finite.
    """
    import torch  # slow to import

    from tracking3d.rendering.visibility import rasterize

    T, intrinsics = finite("T_cam_obj", T_cam_obj, 4, 4), finite("K", K, 3, 3)
    points = finite("vertices", vertices, None, 3) @ T[:3, :3].T + T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        screen = (points @ intrinsics.T)[:, :2] / points[:, 2:]
    front = torch.tensor(floats("faces", faces, None, 3), dtype=torch.int64)
    drawn = rasterize(
        torch.tensor(np.nan_to_num(screen), dtype=torch.float32)[None],
        torch.tensor(points[:, 2], dtype=torch.float32)[None],
        torch.cat([front, front.flip(1)]),
        (size[1], size[0]),
    )
    depth = drawn.depth[0].double().numpy()
    return np.where(np.isfinite(depth), depth, 0.0)


def _visible_pixels(model: NDArray[np.float64], test: NDArray[np.float64], delta: float) -> NDArray[np.bool_]:
    """Where a model at distances ``(H, W)`` is not hidden by the scene; without a measurement it is not."""
    return (model > 0) & ((model - test <= delta) | (test == 0))
