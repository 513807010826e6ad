"""Surface and poses put right by landmarks: points that the images follow consistently over many views.

Points are followed from several views through all others, bundled with the poses, and the surface is moved under
those that are consistent. With better surface and poses the images are warped better into one another, so that
points are followed better: it is done several times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.points.bundle import bundle
from tracking3d.points.carrying import Warps
from tracking3d.points.chain import follow_chain
from tracking3d.points.meeting import surface_under
from tracking3d.points.surface import move_surface
from tracking3d.points.view import Array, View, draw

ROUNDS = 4
START_VIEWS = 8
MOST_SEEDS = 120
"""Landmarks that begin in one view."""
TOLERANCE = 0.03
"""How far behind a drawn surface a point may lie and be seen, in radii of the object."""
_BETWEEN = 7.0  # pixels between seeds
_LEAST_VIEWS = 6  # of a landmark that moves the surface
_DEVIATION = 0.1  # pixels that a measurement is off at best
_POINT, _ROTATION, _TRANSLATION = 0.1, 0.03, 0.03  # priors of the bundle: radii, radians, radii


@dataclass(frozen=True, eq=False)
class Scene:
    """A rigid surface in T views.

    Attributes:
        views: None where the object was not found.
        vertices: ``(V, 3)`` in object coordinates.
        faces: ``(F, 3)``.
    """

    views: list[View | None]
    vertices: Array
    faces: NDArray[np.int64]

    @property
    def radius(self) -> float:
        """Half the diagonal of the object's box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0))) / 2

    def warps(self) -> Warps:
        """The views for carrying points between them."""
        return Warps(self.views, TOLERANCE * self.radius)

    def redrawn(self, vertices: Array, poses: dict[int, Array]) -> Scene:
        """The same views with another surface in other poses, by index of the view."""
        views = [
            None if view is None else draw(view, vertices, self.faces, poses[index])
            for index, view in enumerate(self.views)
        ]
        return Scene(views, vertices, self.faces)


def refine_scene(
    scene: Scene, rounds: int = ROUNDS, after_round: Callable[[int], None] = lambda done: None
) -> Scene:
    """Put surface and poses right, as far as the images say how.

    Args:
        scene: As a run left it.
        rounds: How many times.
        after_round: Is told how many are done.
    """
    for done in range(1, rounds + 1):
        scene = _refine_once(scene)
        after_round(done)
    return scene


def _refine_once(scene: Scene) -> Scene:
    there = [index for index, view in enumerate(scene.views) if view is not None]
    warps = scene.warps()
    spread = np.unique(np.linspace(0, max(len(there) - 1, 0), START_VIEWS).round().astype(int))
    starts = [there[at] for at in spread if at < len(there)]
    found = [
        (face, barycentric, follow_chain(warps, start, xy))
        for start in starts
        for face, barycentric, xy in [_seeds(scene, start)]
        if len(xy)
    ]
    if not found:
        return scene
    face, barycentric = (np.concatenate([one[part] for one in found]) for part in (0, 1))
    points = np.einsum("nk,nkd->nd", barycentric, scene.vertices[scene.faces[face]])
    views = [view for view in scene.views if view is not None]
    intrinsics, T = np.stack([v.intrinsics for v in views]), np.stack([v.T_cam_obj for v in views])
    measured = np.concatenate([one[2].measured[there] for one in found], 1)
    deviation = np.sqrt(np.concatenate([one[2].variance[there] for one in found], 1) + _DEVIATION**2)
    radius = scene.radius
    landmarks, T, weight = bundle(
        points, intrinsics, T, measured, deviation, _POINT * radius, _ROTATION, _TRANSLATION * radius
    )
    kept = (weight > 0).sum(0) >= min(_LEAST_VIEWS, len(there))
    vertices = move_surface(scene.vertices, scene.faces, face[kept], barycentric[kept], landmarks[kept])
    return scene.redrawn(vertices, dict(zip(there, T, strict=True)))


def _seeds(scene: Scene, index: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Where landmarks begin in a view: face, weights of its corners, and pixel of each."""
    view = scene.views[index]
    assert view is not None
    inside = cv2.erode(((view.beyond == 0) & (view.mask > 0.5)).astype(np.uint8), np.ones((5, 5), np.uint8))
    corners = cv2.goodFeaturesToTrack(
        view.image.clip(0, 255).astype(np.uint8), MOST_SEEDS, 0.005, _BETWEEN, mask=inside
    )
    xy = np.zeros((0, 2)) if corners is None else corners[:, 0].astype(np.float64)
    face, barycentric = surface_under(*view.project(scene.vertices), scene.faces, xy)
    on = face >= 0
    return face[on], barycentric[on], xy[on]
