"""Finds the axis of a plain surface of revolution, such as a bottle's, by the mirror symmetry of its views.

Seen from anywhere, such an object is its own mirror image in the plane through the camera and its axis: its outline
exactly, its small marks only if they run around it. That tells that it is one, however wrong the map's poses are, and
with the poses it tells where the axis is. No rotation about it changes any view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.feature_space import contrast_of
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.mapping.global_refinement import fit_keyframes
from tracking3d.estimation.online.mapping.photometric_adjustment import fit_jointly
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose
from tracking3d.estimation.online.optimization.revolution import FloatArray, FreeAxis
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.pose import pose_arrays

_MIN_VIEWS = 6  # views that show the object whole (chosen)
# IoU of a mask and its mirror image, in at least nine of ten views: .978 and more on bottles, bowls and vases, .941 and
# less on 36 sequences of other plain things (measured with true masks)
_MIN_SYMMETRY = 0.962
# Brightness, in [0, 1], by which an object's marks may differ from their mirror images in the median view: .053 and
# less on nine objects without marks (shadow inside a bowl), .059 and more on two with ten strokes (measured). Between
# photos .038 and less on four vases of rings, .147 and more on five other sets (measured)
_MOST_MARKED = 0.055
_MOST_QUANTILE = 0.995  # of the pixels
_MIN_LEAD = 0.005  # IoU by which the axis leads any other that is `_OTHER` degrees away (chosen)
_OTHER = 20.0
_DIRECTIONS = 1500  # that are tried for the axis (chosen)
_STEP = 3.0  # degrees between the lines that are tried in an image (chosen)
_MOST_VIEWS = 15  # keyframes that a surface of revolution is fitted to
_EVALUATIONS = 20  # of that fit
# Mean IoU of that surface with the masks, and by how much it may fall (chosen; it fell by .013 at most on seven
# surfaces of revolution, and by .017 on a knob whose nub is seen in some views)
_MIN_OVERLAP, _MOST_LOST = 0.95, 0.015


@dataclass(frozen=True, eq=False)
class _Mirror:
    """How much a view is its own mirror image, in planes through the camera and the object's middle."""

    axes: FloatArray  # (3, 3) camera axes: across the ray through the object's middle, twice, and along it
    symmetry: FloatArray  # (N,) IoU of the mask and its mirror image, for each angle of the plane's line
    best: float  # the highest one between those angles
    marked: float  # by how much marks differ from their mirror images there
    whole: bool  # whether the object is seen whole; else these say less

    def at(self, directions: FloatArray) -> FloatArray:
        """``(N,)`` symmetry about the images of lines along camera directions ``(N, 3)``."""
        across = directions @ self.axes[:2].T
        angle = np.degrees(np.arctan2(across[:, 1], across[:, 0])) % 180
        return np.interp(angle, _STEP * np.arange(len(self.symmetry) + 1), [*self.symmetry, self.symmetry[0]])


def find_free_axis(object_map: ObjectMap, others: Sequence[Keyframe] = ()) -> FreeAxis | None:
    """The axis about which no rotation of the object can be seen in a map's keyframes; None if there is none.

    Args:
        object_map: A map without points.
        others: More views, which have to look as symmetric: keyframes are those that the map explains.
    """
    centre = object_map.vertices.mean(0).double().cpu().numpy()
    views = []
    for view in object_map.keyframes:
        R, t = pose_arrays(view.pose)
        mirror = _mirror(view.observation, R @ centre + t)
        views += [] if mirror is None else [(mirror, R, t)]
    whole = [mirror for mirror, _, _ in views if mirror.whole]
    if not _look_symmetric(whole):
        return None
    known = {view.index for view in object_map.keyframes}
    more = [_mirror(view.observation) for view in others if view.index not in known]
    whole += [mirror for mirror in more if mirror is not None]
    if len(whole) < _MIN_VIEWS or not _look_symmetric(whole):
        return None

    def symmetry(axes: FloatArray) -> FloatArray:
        return np.asarray(np.mean([mirror.at(axes @ R.T) for mirror, R, _ in views], 0))

    number = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1 - number / _DIRECTIONS, np.pi * (1 + np.sqrt(5)) * number  # evenly over half a sphere
    tried = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    found = symmetry(tried)
    axis, lead = tried[found.argmax()], found.max()
    if lead - found[np.abs(tried @ axis) < np.cos(np.radians(_OTHER))].max() < _MIN_LEAD:
        return None
    for width in (0.04, 0.02, 0.01):
        near = axis + width * np.stack(np.meshgrid(*3 * [[-1.0, -0.5, 0.0, 0.5, 1.0]]), -1).reshape(-1, 3)
        near /= np.linalg.norm(near, axis=1, keepdims=True)
        axis = near[symmetry(near).argmax()]
    return FreeAxis(axis, _point(object_map, axis, views))


def as_surface_of_revolution(
    object_map: ObjectMap, weights: FitWeights, others: Sequence[Keyframe] = ()
) -> ObjectMap:
    """The map with a surface of revolution about its free axis, if it has one and that surface fits; else without.

    Args:
        object_map: A map without points.
        weights: The weights of the shape's terms.
        others: See `find_free_axis`.
    """
    axis = find_free_axis(object_map, others)
    free = replace(object_map, free_axis=None) if object_map.free_axis is not None else object_map
    if axis is None or object_map.free_axis is not None:
        return free if axis is None else object_map
    vertices = axis.revolved(object_map.vertices, object_map.shape.faces)
    chosen = set(np.linspace(0, len(object_map.keyframes) - 1, _MOST_VIEWS).round().astype(int).tolist())
    fitted = [view for place, view in enumerate(object_map.keyframes) if place in chosen]
    found = replace(object_map, vertices=vertices, keyframes=tuple(fitted), free_axis=axis)
    found, _ = fit_jointly(found, ShapeBasis.of(object_map.shape), weights, _EVALUATIONS)
    surface, posed = found.surface(), {view.index: view for view in found.keyframes}
    keyframes = tuple(
        posed.get(view.index)
        or replace(view, pose=refine_pose(surface, view.observation, view.pose).pose, texture=None)
        for view in object_map.keyframes
    )
    found = replace(found, keyframes=keyframes)
    before, overlap = (float(np.mean([fit.overlap for fit in fit_keyframes(m)])) for m in (object_map, found))
    return found if overlap >= max(_MIN_OVERLAP, before - _MOST_LOST) else free


def look_revolved(views: Sequence[Keyframe]) -> bool:
    """Whether photos, cut out by their masks, show a surface of revolution: outlines mirror themselves, marks stay."""
    seen = [view.observation for view in views if view.observation.has_mask]
    mirrors = [mirror for one in seen if (mirror := _mirror(one)) is not None]
    if len(mirrors) < _MIN_VIEWS or np.quantile([one.best for one in mirrors], 0.1) < _MIN_SYMMETRY:
        return False
    marks, inner = zip(*((_marks(one), _inner(one.mask.cpu().numpy()) > 0) for one in seen), strict=True)
    moved = [_difference(marks[n], marks[n + 1], inner[n] & inner[n + 1]) for n in range(len(seen) - 1)]
    return bool(np.median(moved) <= _MOST_MARKED)


def _marks(seen: Observation) -> NDArray[np.float32]:
    """``(H, W)`` brightness without what changes slowly."""
    return np.asarray(cv2.GaussianBlur(contrast_of(seen.image, len(seen.mask))[0].cpu().numpy(), (0, 0), 1.5))


def _inner(mask: NDArray[np.float32]) -> NDArray[np.float32]:
    """``(H, W)`` 1 inside a mask, away from its outline."""
    return np.asarray(cv2.erode((mask > 0.9).astype(np.float32), np.ones((9, 9))))


def _difference(one: NDArray[np.float32], other: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    """What two pictures of marks differ by at most, but for few pixels."""
    return float(np.quantile(np.abs(one - other)[where], _MOST_QUANTILE)) if where.any() else 0.0


def _look_symmetric(mirrors: Sequence[_Mirror]) -> bool:
    if not mirrors:
        return True
    symmetric = np.quantile([mirror.best for mirror in mirrors], 0.1) >= _MIN_SYMMETRY
    return bool(symmetric and np.median([mirror.marked for mirror in mirrors]) <= _MOST_MARKED)


def _mirror(seen: Observation, centre: FloatArray | None = None) -> _Mirror | None:
    """See `_Mirror`; None without a mask, or if the object is cut and its ``centre`` in camera axes is not given."""
    known = seen.valid > 0.5 if seen.occluder is None else (seen.valid > 0.5) & (seen.occluder < 0.5)
    mask, hidden = seen.mask.cpu().numpy(), ~known.cpu().numpy()
    area, size = float(mask.sum()), mask.shape[0]
    around = cv2.dilate((mask > 0.5).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    whole = (around & hidden).sum() <= 0.01 * area
    if not seen.has_mask or area < 100 or not (whole or centre is not None):
        return None
    K = seen.K.double().cpu().numpy()
    ray = (
        np.stack([*np.meshgrid(np.arange(size), np.arange(size)), np.ones((size, size))], -1)
        @ np.linalg.inv(K).T
    )
    length = np.linalg.norm(ray, axis=2)
    middle = ((mask / length**4)[:, :, None] * ray).sum((0, 1))  # of the solid angle: it lies in the plane
    middle = middle if whole or centre is None else centre
    middle /= np.linalg.norm(middle)
    right = np.cross([0.0, 1.0, 0.0], middle)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(middle, right), middle])

    def mirrored(values: NDArray[np.float32], degrees: float) -> NDArray[np.float32]:
        angle = np.radians(degrees)
        normal = np.cos(angle) * axes[1] - np.sin(angle) * axes[0]
        H = K @ (np.eye(3) - 2 * np.outer(normal, normal)) @ np.linalg.inv(K)
        return np.asarray(cv2.warpPerspective(values, H, (size, size), flags=cv2.INTER_LINEAR))

    def symmetry(degrees: float) -> float:
        image = mirrored(mask, degrees)
        both = ~hidden & (mirrored(known.float().cpu().numpy(), degrees) > 0.5)
        return float(
            np.minimum(mask, image)[both].sum() / max(float(np.maximum(mask, image)[both].sum()), 1.0)
        )

    found = np.array([symmetry(degrees) for degrees in np.arange(0, 180, _STEP)])
    angles = _STEP * found.argmax() + np.arange(-_STEP, _STEP + 0.1, 0.5)
    best, angle = max((symmetry(degrees), degrees) for degrees in angles)
    marks, inside = _marks(seen), _inner(mask)
    both = (inside > 0) & (mirrored(inside, angle) > 0.5)
    marked = _difference(marks, mirrored(marks, angle), both)
    return _Mirror(axes, found, best, marked, bool(whole))


def _point(
    object_map: ObjectMap, axis: FloatArray, views: list[tuple[_Mirror, FloatArray, FloatArray]]
) -> FloatArray:
    """The point of the axis beside the surface's middle: the planes of all views pass through it."""
    middle = object_map.vertices.mean(0).double().cpu().numpy()
    rows, sides = [0.1 * axis], [0.1 * float(axis @ middle)]
    for mirror, R, t in views:
        normal = np.cross(R @ axis, mirror.axes[2])
        rows.append(R.T @ normal)
        sides.append(-float(normal @ t))
    return np.asarray(np.linalg.lstsq(np.array(rows), np.array(sides), rcond=None)[0])
