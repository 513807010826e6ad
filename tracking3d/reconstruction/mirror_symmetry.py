"""Planes of mirror symmetry of a surface of which a part was seen.

Two points of a surface with their normals determine one plane in which they are mirror images. Of the planes of many
random pairs, those that map most of the seen surface onto itself are refined and tested: the rest has to be mapped to
where no frame has looked, for otherwise a frame would have shown the object there. If three faces of a box at a corner
were seen, the planes half-way between opposite faces pass this test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]

MIN_SUPPORT = 0.5
"""Share of the seen surface that a plane has to map onto the seen surface."""
MAX_CONTRADICTED = 0.03
"""Share of the seen surface that may be mapped to where frames have seen nothing."""
_TOLERANCE = 0.012  # of the diagonal, between a mapped point and the surface
_REACH = 2.5  # of the tolerance, along the surface: points on it are so dense
_SAME_NORMAL = 0.9  # cosine
_PAIRS = 4000  # that are drawn
_SCREENED, _TESTED = 120, 1500  # points that screen the planes, and that test the best of them
_CANDIDATES = 8  # planes that are refined
_MIN_SCREENED = 0.3  # their support at first
_SLIDE, _OFFSETS = 6.0, 33  # how far a plane is slid along its normal, in tolerances, and in how many steps
_SLID = 700  # points that say which offset is best
_AS_GOOD = 0.005  # difference in support
_SAME_PLANE, _MAX_PLANES = 0.9, 3  # cosine between the normals of two planes that count as one
_NEARLY_SAME_PLANE = 0.985  # the same before planes are refined


@dataclass(frozen=True, eq=False)
class SymmetryPlane:
    """A plane in which an object is its own mirror image."""

    normal: FloatArray  # (3,) unit vector
    offset: float  # of its points along the normal
    support: float  # share of the seen surface that it maps onto the seen surface

    def reflect(self, points: FloatArray) -> FloatArray:
        """The mirror images of points ``(N, 3)``."""
        return _reflect(points, self.normal, self.offset)


def find_symmetry_planes(
    points: FloatArray,
    normals: FloatArray,
    is_free: Callable[[FloatArray], NDArray[np.bool_]],
    seed: int = 0,
) -> list[SymmetryPlane]:
    """Planes of symmetry that the seen part of a surface supports, those with the largest support first.

    Args:
        points: ``(N, 3)`` of the seen surface, spread over it evenly.
        normals: ``(N, 3)`` its unit normals there.
        is_free: Whether frames have shown that there is nothing at some points ``(M, 3)``.
        seed: Of the pairs that are drawn.
    """
    if len(points) < _SCREENED:
        return []
    generator = np.random.default_rng(seed)
    tolerance = _TOLERANCE * float(np.linalg.norm(np.ptp(points, axis=0)))
    surface = _Surface(points, normals, cKDTree(points), tolerance)
    screened = generator.choice(len(points), _SCREENED, replace=False)
    planes = _draw_planes(points, normals, generator)
    support = np.array([surface.support(screened, normal, offset) for normal, offset in planes])
    tested = generator.choice(len(points), min(_TESTED, len(points)), replace=False)
    found: list[SymmetryPlane] = []
    candidates = _select_distinct(planes, support)
    for normal, offset in candidates:
        normal, offset = surface.refine(tested, normal, offset)
        offset = surface.centre(tested[:_SLID], normal, offset)
        share = surface.support(tested, normal, offset)
        elsewhere = tested[~surface.matches(tested, normal, offset)]
        contradicted = is_free(_reflect(points[elsewhere], normal, offset)).sum() / len(tested)
        if share >= MIN_SUPPORT and contradicted <= MAX_CONTRADICTED:
            found.append(SymmetryPlane(normal, offset, share))
    found.sort(key=lambda plane: -plane.support)
    kept: list[SymmetryPlane] = []
    for plane in found:
        if all(abs(plane.normal @ other.normal) < _SAME_PLANE for other in kept):
            kept.append(plane)
    return kept[:_MAX_PLANES]


@dataclass(frozen=True, eq=False)
class _Surface:
    """The seen surface: points ``(N, 3)``, their normals, and the distance within which points are the same."""

    points: FloatArray
    normals: FloatArray
    tree: cKDTree
    tolerance: float

    def matches(self, asked: NDArray[np.int64], normal: FloatArray, offset: float) -> NDArray[np.bool_]:
        """Whether points ``(M,)``, by their numbers, have their mirror images on the surface."""
        images = _reflect(self.points[asked], normal, offset)
        turned = _reflect(self.normals[asked], normal, 0.0)
        _, nearest = self.tree.query(images, distance_upper_bound=_REACH * self.tolerance)
        there = nearest < len(self.points)
        nearest = np.where(there, nearest, 0)
        apart = np.abs(((images - self.points[nearest]) * self.normals[nearest]).sum(1))
        alike = (turned * self.normals[nearest]).sum(1) > _SAME_NORMAL
        return np.asarray(there & alike & (apart < self.tolerance))

    def support(self, asked: NDArray[np.int64], normal: FloatArray, offset: float) -> float:
        """Share of points whose mirror images are on the surface."""
        return float(self.matches(asked, normal, offset).mean())

    def refine(self, asked: NDArray[np.int64], normal: FloatArray, offset: float) -> tuple[FloatArray, float]:
        """The plane near a plane for which mirror images are nearest to the surface's tangent planes."""
        for _ in range(2):
            matched = asked[self.matches(asked, normal, offset)]
            if len(matched) < 10:
                break
            _, nearest = self.tree.query(_reflect(self.points[matched], normal, offset))

            def distances(
                plane: FloatArray,
                matched: NDArray[np.int64] = matched,
                nearest: NDArray[np.int64] = nearest,
            ) -> FloatArray:
                images = _reflect(self.points[matched], plane[:3] / np.linalg.norm(plane[:3]), plane[3])
                return np.asarray(((images - self.points[nearest]) * self.normals[nearest]).sum(1))

            fitted = least_squares(
                distances, np.append(normal, offset), loss="soft_l1", f_scale=0.3 * self.tolerance
            ).x
            normal, offset = fitted[:3] / np.linalg.norm(fitted[:3]), float(fitted[3])
        return normal, offset

    def centre(self, asked: NDArray[np.int64], normal: FloatArray, offset: float) -> float:
        """The offset near an offset with which most of the surface is its own image.

        A flat side can slide along itself; only its ends determine where its middle is. Since images near the ends
        match within a tolerance, several offsets are equally good, and their mean is taken.
        """
        offsets = offset + self.tolerance * np.linspace(-_SLIDE, _SLIDE, _OFFSETS)
        support = np.array([self.support(asked, normal, one) for one in offsets])
        return float(offsets[support >= support.max() - _AS_GOOD].mean())


def _reflect(points: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    return np.asarray(points - 2 * (points @ normal - offset)[:, None] * normal)


def _draw_planes(
    points: FloatArray, normals: FloatArray, generator: np.random.Generator
) -> list[tuple[FloatArray, float]]:
    """The planes between the points of random pairs, of those whose normals are mirror images, too."""
    first, second = generator.integers(0, len(points), (2, _PAIRS))
    between = points[second] - points[first]
    length = np.linalg.norm(between, axis=1)
    far = length > 0.2 * length.max()
    first, second, between = first[far], second[far], between[far] / length[far, None]
    turned = normals[first] - 2 * (normals[first] * between).sum(1)[:, None] * between
    alike = (turned * normals[second]).sum(1) > _SAME_NORMAL
    middle = (points[first] + points[second]) / 2
    offsets = (between * middle).sum(1)
    return [(normal, float(offset)) for normal, offset in zip(between[alike], offsets[alike], strict=True)]


def _select_distinct(
    planes: list[tuple[FloatArray, float]], support: NDArray[np.float64]
) -> list[tuple[FloatArray, float]]:
    """The planes with the largest support, those that are nearly the same as a better one left out."""
    kept: list[tuple[FloatArray, float]] = []
    for place in np.argsort(-support, kind="stable"):
        normal, offset = planes[place]
        if len(kept) == _CANDIDATES or support[place] < _MIN_SCREENED:
            break
        if all(abs(normal @ other) < _NEARLY_SAME_PLANE for other, _ in kept):
            kept.append((normal, offset))
    return kept
