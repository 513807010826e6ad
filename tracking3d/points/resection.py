"""The pose of one more view, from points of views whose poses are right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tracking3d.points.bundle import bundle
from tracking3d.points.carrying import Warps
from tracking3d.points.landmarks import DEVIATION, TOLERANCE, LandmarkScene, seeds
from tracking3d.points.view import Array, SurfaceView, redraw_surface

TURNS = 2
_FIXED = 1e-6  # deviation in radii of points that stay where they are


def resect(scene: LandmarkScene, view: SurfaceView, known: Sequence[int]) -> tuple[SurfaceView, float]:
    """A view drawn at the pose at which it shows what other views show, and how much of that it shows there.

    The second is in [0, 1]: the share of their points that it shows where surface and pose put them.

    Args:
        scene: Surface and views, put right; see `tracking3d.points.landmarks.refine_scene`.
        view: The further one, drawn at about its pose.
        known: Which views of the scene are looked at; those near in time show most of what it shows.
    """
    share = 0.0
    for _ in range(TURNS):
        others = [scene.views[index] for index in known]
        warps = Warps([*others, view], TOLERANCE * scene.radius)
        found = [
            _carried(scene, warps, source) for source in range(len(others)) if others[source] is not None
        ]
        if not found:
            return view, share
        points, measured, deviation = (np.concatenate(part) for part in zip(*found, strict=True))
        placed = bundle(
            points,
            view.intrinsics[None],
            view.T_cam_obj[None],
            measured[None],
            deviation[None],
            _FIXED * scene.radius,
        )
        share = float(placed.agreeing[0].mean()) if len(points) else 0.0
        view = redraw_surface(view, scene.vertices, scene.faces, placed.T_cam_obj[0])
    return view, share


def _carried(scene: LandmarkScene, warps: Warps, source: int) -> tuple[Array, Array, Array]:
    """Points in space under corners of a view, their pixels in the last view, and deviations of these."""
    view = warps.views[source]
    assert view is not None
    face, barycentric, xy = seeds(view, scene.vertices, scene.faces)
    points = np.einsum("nk,nkd->nd", barycentric, scene.vertices[scene.faces[face]])
    carried = warps.carry(source, len(warps.views) - 1, xy)
    return points, carried.measured, np.sqrt(carried.variance + DEVIATION**2)
