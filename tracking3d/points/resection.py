"""The pose of one more view, from points of views whose poses are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tracking3d.points.landmark_adjustment import DEVIATION, TOLERANCE, LandmarkScene
from tracking3d.points.robust_bundle import bundle
from tracking3d.points.view import Array, SurfaceView, redraw_surface
from tracking3d.points.warping import Warps

TURNS = 2
_FIXED = 1e-6  # deviation in radii of points that stay where they are


def resect(scene: LandmarkScene, view: SurfaceView, known: Sequence[int]) -> tuple[SurfaceView, float]:
    """A view drawn at the pose at which it shows what other views show, and how much of that it shows there.

    The second is in [0, 1]: the share of their points that it shows where surface and pose put them.

    Args:
        scene: Surface and views, refined; see `tracking3d.points.landmark_adjustment.refine_scene`.
        view: The further one, drawn at about its pose.
        known: Which views of the scene are looked at; those near in time show most of what it shows.
    """
    share = 0.0
    for _ in range(TURNS):
        others = [scene.views[index] for index in known]
        warps = Warps([*others, view], TOLERANCE * scene.radius)
        found = [
            _carry_tracks(scene, warps, source, index)
            for source, index in enumerate(known)
            if others[source] is not None
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


def _carry_tracks(scene: LandmarkScene, warps: Warps, source: int, index: int) -> tuple[Array, Array, Array]:
    """Points in space under corners of a view, their pixels in the last warped view, and deviations of these."""
    face, barycentric, xy = scene.seeds_of(index)
    points = np.einsum("nk,nkd->nd", barycentric, scene.vertices[scene.faces[face]])
    carried = warps.carry(source, len(warps.views) - 1, xy)
    return points, carried.measured, np.sqrt(carried.variance + DEVIATION**2)
