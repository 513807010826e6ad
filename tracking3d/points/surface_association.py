"""Associates points tracked in the images with the surface, once it is known where they lie on it.

Where a followed pixel meets the drawn surface it may be a point of it, or of something in front that no mesh covers.
Which of the two shows as the object turns: the point of the surface goes where the images say only if it is that one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.points.follow import Followed
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.scene.surface import Drawn, sample
from tracking3d.scene.view import Array

_CANDIDATES = 12  # meetings of one point that are looked into
_LEAST_SLANT = 0.3  # cosine between ray and surface; below, a pixel is many points
_NEAR = 2.0  # pixels that surface and poses may be off
_KNOWN = 3.0  # pixels of uncertainty up to which a place in the image counts
_LEAST_AGREEING = 5  # views
_LEAST_SHARE = 0.7  # of the views in which the point is known and the surface is there
_LEAST_TURN = np.cos(np.deg2rad(6.0))  # by which the agreeing views differ; from one side anything agrees


def meetings(
    scene: LandmarkScene, xy: Array, uncertainty: Array, visible: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """In which view each point is known to lie on the surface.

    Args:
        scene: The surface in T views.
        xy: ``(T, N, 2)`` pixels of the frames where the images have the points.
        uncertainty: ``(T, N)`` pixels.
        visible: ``(T, N)`` bool: where they were found.

    Returns:
        ``(N,)`` index of the view; -1 for a point of which that is not known in any.
    """
    known = visible & np.isfinite(xy).all(2) & (uncertainty < _KNOWN)
    known &= np.array([view is not None for view in scene.views])[:, None]
    found = np.full(xy.shape[1], -1, np.int64)
    for point in range(xy.shape[1]):
        rows = np.flatnonzero(known[:, point])
        views = [view for view in (scene.views[row] for row in rows) if view is not None]
        met = _surface_hits(views, xy[rows, point])
        at = _best(views, xy[rows, point], uncertainty[rows, point], met, scene.radius)
        if at is not None:
            found[point] = rows[at]
    return found


def _surface_hits(views: list[Drawn], xy: Array) -> Array:
    """``(V, 3)`` points of the surface under one pixel ``(V, 2)`` of each view; NaN if it does not lie there."""
    points = np.full((len(views), 3), np.nan)
    for row, view in enumerate(views):
        pixel = view.to_window(xy[row : row + 1])
        if sample(view.beyond, pixel)[0] < 0.5 and view.slant(pixel)[0] > _LEAST_SLANT:
            points[row] = view.surface(pixel)[0]
    return points


def _best(views: list[Drawn], xy: Array, uncertainty: Array, met: Array, radius: float) -> int | None:
    """Which meeting explains best where the images have the point; None if none does."""
    on = np.flatnonzero(np.isfinite(met).all(1))
    if len(on) < _LEAST_AGREEING:
        return None
    chosen = on[np.unique(np.linspace(0, len(on) - 1, _CANDIDATES).round().astype(int))]
    seen = [view.sees(met[chosen], 0.03 * radius) for view in views]
    placed = np.stack([view.to_frame(where) for view, (where, _) in zip(views, seen, strict=True)])
    error = np.linalg.norm(placed - xy[:, None], axis=2)  # (V, C)
    with np.errstate(invalid="ignore"):
        agrees = np.stack([sees for _, sees in seen]) & (error < (_NEAR + uncertainty)[:, None])
    enough = (agrees.sum(0) >= _LEAST_AGREEING) & (agrees.sum(0) >= _LEAST_SHARE * len(views))
    best: tuple[float, int] | None = None
    for column in np.flatnonzero(enough).tolist():
        rows = np.flatnonzero(agrees[:, column])
        if _has_turned_enough([views[row] for row in rows], met[chosen[column]]):
            score = float(np.mean(error[rows, column])) - len(rows)
            best = min(best or (np.inf, -1), (score, int(chosen[column])))
    return None if best is None else best[1]


def _has_turned_enough(views: list[Drawn], point: Array) -> bool:
    eyes = np.stack([-view.T_cam_obj[:3, :3].T @ view.T_cam_obj[:3, 3] for view in views]) - point
    direction = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    return bool((direction @ direction.T).min() < _LEAST_TURN)


def merge_image_points(
    surface: Followed, xy: Array, uncertainty: Array, visible: NDArray[np.bool_]
) -> Followed:
    """Points carried by the surface, with what the images alone said of them.

    Their mean by variance counts where they agree; where they do not, the image does in the frames that show the point,
    and how far they are apart is what neither knows.

    Args:
        surface: N points in T views.
        xy: ``(T, N, 2)`` pixels of the frames.
        uncertainty: ``(T, N)`` pixels.
        visible: ``(T, N)`` bool: where the images show them.
    """
    there = np.isfinite(surface.positions).all(2) & np.isfinite(surface.uncertainty)
    found = visible & np.isfinite(xy).all(2)
    mine, other = np.where(there, surface.uncertainty, np.inf), np.where(found, uncertainty, np.inf)
    both = there & found
    apart = np.linalg.norm(np.where(both[..., None], surface.positions - xy, 0.0), axis=2)
    agree = ~both | (apart <= 2 * (mine + other))
    share = np.where(there | found, found.astype(float), np.nan)
    mean = both & agree
    share[mean] = 1 / (1 + (other[mean] / mine[mean]) ** 2)
    positions = np.where(there[..., None], surface.positions, 0.0) * (1 - share[..., None])
    positions = positions + np.where(found[..., None], xy, 0.0) * share[..., None]
    known = np.where(agree, np.minimum(mine, other), np.maximum(other, apart / 2))
    return replace(
        surface,
        positions=positions,
        visible=surface.visible | found,
        uncertainty=np.where(there | found, known, np.nan),
        measured=surface.measured | found,
    )
