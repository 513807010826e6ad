"""Corrects surface and poses by landmarks: points that the images track consistently over many views.

Points are followed from several views through all others, bundled with the poses, and the surface is moved under
those that are consistent. With better surface and poses the images are warped better into one another, so that
points are followed better: it is done several times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from tracking3d.geometry.camera import Camera
from tracking3d.points.bundle_adjustment.adjustment import Reversal
from tracking3d.points.outline_fit import fit_to_outlines, outline_of
from tracking3d.points.ray_intersection import surface_under
from tracking3d.points.robust_bundle import bundle, solve_reversed
from tracking3d.points.view import redraw_surface
from tracking3d.points.warping import Warps, follow_chain
from tracking3d.runtime.progress import report_progress
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import Array

ROUNDS = 6
START_VIEWS = 8
MOST_SEEDS = 120
"""Landmarks that begin in one view."""
TOLERANCE = 0.03
"""How far behind a drawn surface a point may lie and be seen, in radii of the object."""
DEVIATION = 0.1
"""Pixels that a measurement is off at best."""
_BETWEEN = 7.0  # pixels between seeds
_LEAST_VIEWS = 6  # of a landmark that moves the surface
# Points in half of the views; with fewer, adjusted poses were wrong more often than right
_LEAST_SUPPORT = 60
_SETTLED, _TO_COME = np.deg2rad(0.01), np.deg2rad(0.05)
"""Turn of a round that ends them, and what may still be to come if turns go on to shrink as they did. Of an object with
faint texture a round leaves .8 to .9 of an error, so that five to ten times as much is; of others a few tenths."""
_FEW_OUTLINES, _OUTLINE_SHARE = 30, 0.6
"""The surface is fitted to the outlines of so many views, or of that share of more."""
_HELD = 0.1  # deviation of landmarks from the surface, in radii

Corners = tuple[NDArray[np.int64], Array, Array]
"""What `seeds` finds."""


@dataclass(frozen=True)
class LandmarkSupport:
    """What landmarks say of a view's pose."""

    followed: int  # how many of them were found in the view
    agreeing: int  # how many of those where surface and pose put them; 0 if they were too few to be asked


@dataclass(frozen=True, eq=False)
class LandmarkScene:
    """A rigid surface in T views."""

    views: list[Drawn | None]  # none if the object was not found
    vertices: Array  # (V, 3) in object coordinates
    faces: NDArray[np.int64]  # (F, 3)
    focal_factor: float = 1.0  # by which the views' focal lengths are those that they were opened with
    # standard deviation of the logarithm of the focal length; None before it is estimated
    focal_deviation: float | None = None
    # what landmarks say of each view's pose; empty before they were looked for
    support: Mapping[int, LandmarkSupport] = field(default_factory=dict)
    # whether depth may be the other way round than the run has it; no longer once that is clear
    may_reverse: bool = False
    reversal: Reversal | None = None  # what was done to surface and poses, where landmarks said that it was

    @cached_property
    def radius(self) -> float:
        """Half the diagonal of the object's box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0))) / 2

    def seeds_of(self, index: int) -> Corners:
        """Where landmarks begin in a view, see `seeds`; searched for once."""
        if index not in self._seeds:
            view = self.views[index]
            assert view is not None
            self._seeds[index] = seeds(view, self.vertices, self.faces)
        return self._seeds[index]

    @cached_property
    def _seeds(self) -> dict[int, Corners]:
        return {}

    def warps(self) -> Warps:
        """The views for carrying points between them."""
        return Warps(self.views, TOLERANCE * self.radius)

    def redrawn(
        self, vertices: Array, poses: Mapping[int, Array], focal_factor: float = 1.0
    ) -> LandmarkScene:
        """The same views with another surface in other poses, by index of the view, with another focal length."""
        lens = np.diag([focal_factor, focal_factor, 1.0])
        views = [
            None
            if view is None
            else redraw_surface(replace(view, K=view.K @ lens), vertices, self.faces, poses[index])
            for index, view in enumerate(self.views)
        ]
        return replace(
            self, views=views, vertices=vertices, focal_factor=self.focal_factor * focal_factor, support={}
        )


def refine_through(scene: LandmarkScene, rounds: int, camera: Camera) -> LandmarkScene:
    """`refine_scene`, with the focal length if it is not given and the solved one is within the range of lenses."""
    refined = refine_scene(scene, rounds, free_focal=camera.assumed)
    return refined if camera.may_have(refined.focal_factor) else refine_scene(scene, rounds)


def refine_scene(
    scene: LandmarkScene,
    rounds: int = ROUNDS,
    free_focal: bool = False,
) -> LandmarkScene:
    """Refine surface and poses from the images until the rotations converge.

    Where the images say little, as of a plain object, or where poses are so wrong that views do not show each other's
    points, everything stays as it is.

    Args:
        scene: As a run left it.
        rounds: How many times at most.
        free_focal: Whether to estimate the focal length too, because it is not given.
    """
    done, last, turned = 0, rounds, 0.0
    while done < last:
        report_progress("refining poses", done, last)
        done += 1
        before, scene = scene, _refine_once(scene, free_focal)
        turned_before, turned = turned, _rotation_between(before, scene)
        if scene.reversal is not before.reversal:
            last, turned = done + rounds, 0.0  # all of it is new
        elif turned < _SETTLED or turned**2 < _TO_COME * (turned_before - turned):
            break
    report_progress("refining poses", done, done)
    return scene


def fit_outlines(scene: LandmarkScene) -> LandmarkScene:
    """The scene with a surface whose silhouettes lie on the masks: landmarks leave the rim where they found it.

    Outlines have no say while `refine_scene` goes on: where the texture is faint, they would hold the surface where
    poses that are wrong want it.

    Args:
        scene: As `refine_scene` left it; as it is where the images said little.
    """
    if not is_supported(scene):
        return scene
    report_progress("fitting outlines")
    return _fit_surface(_refine_once(replace(_fit_surface(scene), may_reverse=False), free_focal=False))


def is_supported(scene: LandmarkScene) -> bool:
    """Whether the views of a scene shared enough landmarks in `refine_scene` for these to tell anything."""
    return any(support.agreeing for support in scene.support.values())


def _fit_surface(scene: LandmarkScene) -> LandmarkScene:
    views = {index: view for index, view in enumerate(scene.views) if view is not None}
    there = list(views.values())
    outlines = [outline_of(there[place]) for place in views_with_outlines(len(there))]
    vertices = fit_to_outlines(scene.vertices, scene.faces, outlines)
    redrawn = scene.redrawn(vertices, {index: view.T_cam_obj for index, view in views.items()})
    return replace(redrawn, support=scene.support)


def views_with_outlines(count: int) -> NDArray[np.int64]:
    """Places of the views whose outlines are fitted, evenly among ``count`` of them, ascending."""
    most = min(max(_FEW_OUTLINES, round(_OUTLINE_SHARE * count)), count)
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))


def _rotation_between(before: LandmarkScene, after: LandmarkScene) -> float:
    """Median angle in radians by which the poses turned, that of the object frame itself left out."""
    pairs = [
        (a.T_cam_obj, b.T_cam_obj)
        for a, b in zip(before.views, after.views, strict=True)
        if a is not None and b is not None
    ]
    if not pairs:
        return 0.0
    first, second = (np.stack(part)[:, :3, :3] for part in zip(*pairs, strict=True))
    turned = Rotation.from_matrix(first.transpose(0, 2, 1) @ second)
    return float(np.median((turned.mean().inv() * turned).magnitude()))


def _refine_once(scene: LandmarkScene, free_focal: bool) -> LandmarkScene:
    there = [index for index, view in enumerate(scene.views) if view is not None]
    if not there:
        return scene
    views = [view for view in scene.views if view is not None]
    T = np.stack([view.T_cam_obj for view in views])
    corners = [scene.seeds_of(index) for index in there]
    spread = np.unique(np.linspace(0, len(there) - 1, START_VIEWS).round().astype(int))
    begun = _begin(scene, there, corners, spread)
    # Spread evenly, the views may all show one side of an object that goes to and fro or round.
    unreached = np.flatnonzero(begun.followed < [len(xy) for _, _, xy in corners])
    if len(unreached):
        further = unreached[_unlike(T[unreached, :3, :3], START_VIEWS)]
        begun = begun.and_of(_begin(scene, there, corners, further))
    if not len(begun.face):
        return scene
    face, barycentric, followed = begun.face, begun.barycentric, begun.followed.tolist()
    points = np.einsum("nk,nkd->nd", barycentric, scene.vertices[scene.faces[face]])
    if np.median(followed) < _LEAST_SUPPORT:
        return replace(
            scene, support={at: LandmarkSupport(count, 0) for at, count in zip(there, followed, strict=True)}
        )
    solved = partial(
        bundle,
        intrinsics=np.stack([view.intrinsics for view in views]),
        measured=begun.measured,
        deviation=np.sqrt(begun.variance + DEVIATION**2),
        held=_HELD * scene.radius,
    )
    found, vertices = solved(points, T_cam_obj=T), scene.vertices
    other = solve_reversed(points, T, solved, found) if scene.may_reverse else None
    if other is not None and other.is_better:
        found = other.found
        vertices = other.reversal.surface(vertices, points, found.points)
        scene = replace(scene, reversal=other.reversal, may_reverse=False)
    elif free_focal:
        found = solved(points, T_cam_obj=T, begun=found)
    if other is not None and other.is_hopeless:
        scene = replace(scene, may_reverse=False)
    kept = (found.weight > 0).sum(0) >= min(_LEAST_VIEWS, len(there))
    vertices = move_surface(vertices, scene.faces, face[kept], barycentric[kept], found.points[kept])
    counts = zip(there, followed, found.agreeing.sum(1).tolist(), strict=True)
    support = {at: LandmarkSupport(count, agreeing) for at, count, agreeing in counts}
    redrawn = scene.redrawn(vertices, dict(zip(there, found.T_cam_obj, strict=True)), found.focal_factor)
    deviation = scene.focal_deviation if found.focal_deviation is None else found.focal_deviation
    return replace(redrawn, support=support, focal_deviation=deviation)


@dataclass(frozen=True, eq=False)
class _Begun:
    """N landmarks that began in some of T views, and where the images say that they are in each."""

    face: NDArray[np.int64]  # (N,) on which each lies
    barycentric: Array  # (N, 3) where on it
    measured: Array  # (T, N, 2) pixels, see `Chain`
    variance: Array  # (T, N) squared pixels

    @property
    def followed(self) -> NDArray[np.int64]:
        """``(T,)`` how many were found in each view."""
        return np.isfinite(self.variance).sum(1)

    def and_of(self, other: _Begun) -> _Begun:
        """These and others."""
        return _Begun(
            np.concatenate([self.face, other.face]),
            np.concatenate([self.barycentric, other.barycentric]),
            np.concatenate([self.measured, other.measured], axis=1),
            np.concatenate([self.variance, other.variance], axis=1),
        )


def _begin(
    scene: LandmarkScene, there: Sequence[int], corners: Sequence[Corners], starts: NDArray[np.integer]
) -> _Begun:
    """Landmarks that begin in some views, followed through all.

    Args:
        scene: Surface and views.
        there: Places in the scene of the views that there are.
        corners: What `seeds` says of each.
        starts: Which of them landmarks begin in.
    """
    face, barycentric, xy = (
        np.concatenate(part) for part in zip(*(corners[at] for at in starts), strict=True)
    )
    start = np.repeat(np.array(there)[starts], [len(corners[at][2]) for at in starts])
    chain = follow_chain(scene.warps(), start, xy)
    begins = np.repeat(starts, [len(corners[at][2]) for at in starts])
    T = np.stack([view.T_cam_obj for view in scene.views if view is not None])
    one_side = of_one_side(T, scene.vertices, scene.faces[face], begins)
    variance = np.where(one_side, chain.variance[there], np.inf)
    return _Begun(face, barycentric, chain.measured[there], variance)


def of_one_side(
    T_cam_obj: Array, vertices: Array, triangles: NDArray[np.int64], begins: NDArray[np.integer]
) -> NDArray[np.bool_]:
    """Which views look at a landmark's face from the side from which it was first seen.

    The two sides of a card lie closer together than surface and poses are known, so that depth alone does not tell
    that the one hides the other. Landmarks that are followed round the edge by mistake would turn one side against the
    other, further with every round.

    Args:
        T_cam_obj: ``(T, 4, 4)``.
        vertices: ``(V, 3)``.
        triangles: ``(N, 3)`` vertices of the face that each landmark lies on.
        begins: ``(N,)`` the view in which it was first seen.

    Returns:
        ``(T, N)`` bool.
    """
    corner, right, left = vertices[triangles].transpose(1, 0, 2)
    normal = np.cross(right - corner, left - corner)
    eye = -np.einsum("tji,tj->ti", T_cam_obj[:, :3, :3], T_cam_obj[:, :3, 3])
    facing = eye @ normal.T - (corner * normal).sum(1)
    seen: NDArray[np.bool_] = facing * facing[begins, np.arange(len(begins))] > 0
    return seen


def _unlike(R_cam_obj: Array, count: int) -> NDArray[np.int64]:
    """Indices of views ``(N, 3, 3)`` that are turned as far from one another as can be, ascending."""
    chosen, nearest = [0], np.full(len(R_cam_obj), np.inf)
    while len(chosen) < min(count, len(R_cam_obj)):
        trace = np.einsum("nij,ij->n", R_cam_obj, R_cam_obj[chosen[-1]])
        nearest = np.minimum(nearest, np.arccos(np.clip((trace - 1) / 2, -1, 1)))
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return np.sort(np.array(chosen))


def seeds(view: Drawn, vertices: Array, faces: NDArray[np.int64]) -> Corners:
    """Where landmarks begin in a view of a surface: face ``(N,)``, weights of its corners ``(N, 3)``, and pixel
    ``(N, 2)`` of each.
    """
    inside = cv2.erode(((view.beyond == 0) & (view.mask > 0.5)).astype(np.uint8), np.ones((5, 5), np.uint8))
    corners = cv2.goodFeaturesToTrack(
        view.image.clip(0, 255).astype(np.uint8), MOST_SEEDS, 0.005, _BETWEEN, mask=inside
    )
    xy = np.zeros((0, 2)) if corners is None else corners[:, 0].astype(np.float64)
    face, barycentric = surface_under(*view.project(vertices), faces, xy)
    on = face >= 0
    return face[on], barycentric[on], xy[on]


SYMMETRIC: Mapping[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}
}  # fmt: skip
"""Of `scipy.sparse.linalg.splu`, for a factorization that keeps the symmetry of positive equations."""
_STAY = 1e-3  # weight that holds every vertex, so that there is one answer


def move_surface(
    vertices: Array,
    faces: NDArray[np.int64],
    face: NDArray[np.int64],
    barycentric: Array,
    landmarks: Array,
    stiffness: float = 1.0,
) -> Array:
    """Move a mesh so that points on it come to lie on their landmarks.

    The movement is smooth (its Laplacian is small) and robust: a landmark much further off than most counts little.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        face: ``(N,)`` the face that each point lies on.
        barycentric: ``(N, 3)`` where on it.
        landmarks: ``(N, 3)``.
        stiffness: Weight of the smoothness.

    Returns:
        ``(V, 3)`` vertices.
    """
    count = len(face)
    if not count:
        return vertices
    rows = np.repeat(np.arange(count), 3)
    on = sparse.csr_matrix((barycentric.ravel(), (rows, faces[face].ravel())), shape=(count, len(vertices)))
    gap = landmarks - on @ vertices
    length = np.linalg.norm(gap, axis=1)
    weight = 1 / (1 + (length / (3 * np.median(length) + 1e-12)) ** 2)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    joined = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2).tocsr()
    joined = ((joined + joined.T) > 0).astype(float)
    neighbours = np.maximum(np.asarray(joined.sum(1)).ravel(), 1)
    laplacian = sparse.eye(len(vertices)) - sparse.diags(1 / neighbours) @ joined
    H = (
        on.T @ sparse.diags(weight) @ on
        + stiffness * (laplacian.T @ laplacian)
        + _STAY * sparse.eye(len(vertices))
    )
    moved: Array = vertices + splu(H.tocsc(), **SYMMETRIC).solve(on.T @ (weight[:, None] * gap))
    return moved


TURNS = 2
STILL = np.deg2rad(0.05)
"""Turn of a view below which it is not drawn and adjusted once more (measured: what follows is a tenth of it)."""
_FIXED = 1e-6  # deviation in radii of points that stay where they are


def resect(
    scene: LandmarkScene, view: Drawn, known: Sequence[int], turns: int = TURNS
) -> tuple[Array, float]:
    """The pose ``(4, 4)`` at which a view shows what other views show, and how much of that it shows there.

    The second is in [0, 1]: the share of their points that it shows where surface and pose put them.

    Args:
        scene: Surface and views, refined; see `tracking3d.points.landmark_adjustment.refine_scene`.
        view: The further one, drawn at about its pose.
        known: Which views of the scene are looked at; those near in time show most of what it shows.
        turns: How often it is drawn and adjusted, at most.
    """
    share, others = 0.0, [scene.views[index] for index in known]
    for turn in range(turns):
        warps = Warps([*others, view], TOLERANCE * scene.radius)
        found = [
            _carry_tracks(scene, warps, source, index)
            for source, index in enumerate(known)
            if others[source] is not None
        ]
        if not found:
            break
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
        T_cam_obj = placed.T_cam_obj[0]
        turned = T_cam_obj[:3, :3] @ view.T_cam_obj[:3, :3].T
        if turn + 1 == turns or Rotation.from_matrix(turned).magnitude() < STILL:
            return T_cam_obj, share
        view = redraw_surface(view, scene.vertices, scene.faces, T_cam_obj)
    return view.T_cam_obj, share


def _carry_tracks(scene: LandmarkScene, warps: Warps, source: int, index: int) -> tuple[Array, Array, Array]:
    """Points in space under corners of a view, their pixels in the last warped view, and deviations of these."""
    face, barycentric, xy = scene.seeds_of(index)
    points = np.einsum("nk,nkd->nd", barycentric, scene.vertices[scene.faces[face]])
    carried = warps.carry(source, len(warps.views) - 1, xy)
    return points, carried.measured, np.sqrt(carried.variance + DEVIATION**2)
