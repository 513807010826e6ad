"""Tracks points while the views arrive: each estimate uses the views up to then.

As many views are kept as the templates reach back and a point in space is settled by; what is kept does not grow.
Poses that are answered at the time are some pixels off, so that points of a grid on the object are followed beside
those that were asked for, and the poses of the kept views are bundled with them. When surface or poses of the past
become known better, the kept views are drawn and gone through again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera
from tracking3d.points.answers import PointAnswers
from tracking3d.points.follow import RIM, combine_with_images
from tracking3d.points.landmark_adjustment import TOLERANCE
from tracking3d.points.robust_bundle import bundle
from tracking3d.points.view import redraw_surface
from tracking3d.points.warping import CHAIN_STEPS as STEPS
from tracking3d.points.warping import Chain, Warps, extend
from tracking3d.scene.surface import Drawn, sample
from tracking3d.scene.view import Array

KEPT = 16
"""Views that are kept; no fewer than the templates reach back."""
assert max(STEPS) <= KEPT
_GRID = 8  # along either side of the window
# Pixels that a measurement is off at best: first all have a say, then those that agree
_SETTLING = 1.0, 0.3, 0.1
_HELD = 0.1  # deviation of the points from the surface, in radii

Known = Callable[[int], tuple[Camera, Array] | None]
"""Camera and ``(4, 4)`` ``T_cam_obj`` of the frame with an index; None if they are not known better than before."""


@dataclass(eq=False)
class _Row:
    """What is known of N points in one view; see `Chain`."""

    index: int
    view: Drawn | None
    measured: Array
    variance: Array
    likeness: Array


class CausalPoints:
    """The points that one frame was asked for, followed through the frames that come after it.

    Args:
        xy: ``(N, 2)`` pixels of that frame.
    """

    def __init__(self, xy: Array) -> None:
        self.xy = xy
        self._all = xy
        self._rows: list[_Row] = []
        self._first: _Row | None = None

    def step(self, index: int, view: Drawn | None, radius: float) -> PointAnswers:
        """The estimates for the next frame; the first one is the query frame.

        Args:
            index: The index of the frame.
            view: Of the object in it; None if it is lost.
            radius: The radius of the object.
        """
        if self._first is None and view is not None:
            self._all = np.concatenate([self.xy, _grid(view)])
        size = len(self._all)
        row = _Row(index, view, np.full((size, 2), np.nan), np.full(size, np.inf), np.full(size, -1.0))
        if self._first is None:
            if view is not None:
                row.measured, row.variance[:], row.likeness[:] = view.to_window(self._all), 0.0, 1.0
            self._first = row
        elif self._turns(index):
            self._rows = [self._first]
        self._rows = [*self._rows, row][-KEPT:]
        return self._answer(row, radius)

    def on_surface(self) -> NDArray[np.bool_]:
        """``(N,)`` which points lie on the surface as it is known now; none where the object is lost."""
        if self._first is None or self._first.view is None:
            return np.zeros(len(self.xy), bool)
        view = self._first.view
        pixels = view.to_window(self.xy)
        return np.asarray(np.isfinite(view.surface(pixels)).all(1) & (sample(view.beyond, pixels) < RIM))

    def redrawn(self, known: Known, vertices: Array, faces: NDArray[np.int64]) -> None:
        """Draw another surface into the kept views, in the poses that are known now; `again` answers by them.

        Args:
            known: What is known of the frames.
            vertices: ``(V, 3)``.
            faces: ``(F, 3)``.
        """
        for row in {id(one): one for one in (self._first, *self._rows) if one is not None}.values():
            if row.view is None:
                continue
            view, better = row.view, known(row.index)
            T_cam_obj = view.T_cam_obj
            if better is not None:
                camera, T_cam_obj = better
                view = replace(view, K=view.window.K(camera))
            row.view = redraw_surface(view, vertices, faces, T_cam_obj)

    def again(self, radius: float) -> dict[int, PointAnswers]:
        """The estimates for the kept frames again, by frame; empty unless the query frame is among them."""
        rows, first = self._rows, self._first
        if first is None or first not in rows:
            return {}
        estimates: dict[int, PointAnswers] = {}
        self._rows = []
        for row in rows[rows.index(first) :]:
            if row is not first:
                row.measured[:], row.variance[:], row.likeness[:] = np.nan, np.inf, -1.0
            self._rows.append(row)
            estimates[row.index] = self._answer(row, radius)
        return estimates

    def _turns(self, index: int) -> bool:
        """Whether a frame comes from before the first one, now that the last one is done."""
        if len(self._rows) < 2:
            return False
        before, last = self._rows[-2].index, self._rows[-1].index
        return (index - last) * (last - before) < 0

    def _answer(self, row: _Row, radius: float) -> PointAnswers:
        first, count = self._first, len(self.xy)
        estimate = PointAnswers.unknown(count)
        if row.view is None or first is None or first.view is None:
            return estimate
        pixels = first.view.to_window(self._all)
        points = first.view.surface(pixels)
        on = np.flatnonzero(np.isfinite(points).all(1) & (sample(first.view.beyond, pixels) < RIM))
        asked = int((on < count).sum())
        if not asked:
            return estimate
        if row is not first:
            self._measure(row, radius)
        rows = [one for one in self._rows if one.view is not None]
        chain = Chain(
            *(
                np.stack([part[on] for part in parts])
                for parts in zip(*((one.measured, one.variance, one.likeness) for one in rows), strict=True)
            )
        )
        views = _adjust_bundle([one.view for one in rows if one.view is not None], points[on], chain, radius)
        gap = np.array([abs(one.index - first.index) for one in rows])
        chain = Chain(chain.measured[:, :asked], chain.variance[:, :asked], chain.likeness[:, :asked])
        on = on[:asked]
        seen = combine_with_images(views, points[on], chain, first.view.slant(pixels[on]), gap, radius)
        estimate.positions[on], estimate.visible[on] = seen.positions[-1], seen.visible[-1]
        estimate.uncertainty[on], estimate.points[on] = seen.uncertainty[-1], seen.points
        estimate.measured[on] = seen.measured[-1]
        if row is first:
            estimate.positions[on], estimate.visible[on] = self.xy[on], True
        return estimate

    def _measure(self, row: _Row, radius: float) -> None:
        """Write into a row what the templates say of its view: those before it, and that of the question."""
        first, rows = self._first, self._rows
        assert first is not None
        held = rows if first in rows else [first, *rows]
        target = len(held) - 1
        chain = Chain(
            np.stack([one.measured for one in held]),
            np.stack([one.variance for one in held]),
            np.stack([one.likeness for one in held]),
        )
        warps = Warps([one.view for one in held], TOLERANCE * radius)
        least = held.index(first)
        offset = 0 if first in rows else 1
        before = [target - step for step in STEPS if target - step >= max(least, offset)]
        everything = np.ones(chain.variance.shape[1], np.bool_)
        extend(chain, warps, target, [(source, everything) for source in before])
        missing = ~np.isfinite(chain.variance[target])
        if missing.any() and least not in before:
            extend(chain, warps, target, [(least, missing)])
        row.measured, row.variance, row.likeness = (
            chain.measured[target],
            chain.variance[target],
            chain.likeness[target],
        )


def _adjust_bundle(views: list[Drawn], points: Array, chain: Chain, radius: float) -> list[Drawn]:
    """The views in poses that agree with what the images say of the points; as they are drawn otherwise."""
    intrinsics, poses = (
        np.stack([one.intrinsics for one in views]),
        np.stack([one.T_cam_obj for one in views]),
    )
    for least in _SETTLING:
        deviation = np.sqrt(chain.variance + least**2)
        found = bundle(points, intrinsics, poses, chain.measured, deviation, _HELD * radius)
        points, poses = found.points, found.T_cam_obj
    return [replace(one, T_cam_obj=T) for one, T in zip(views, poses, strict=True)]


def _grid(view: Drawn) -> Array:
    """``(N, 2)`` pixels of the frame, all over the object."""
    height, width = view.beyond.shape
    steps = (np.arange(_GRID) + 0.5) / _GRID
    x, y = (one.ravel() for one in np.meshgrid(steps * width - 0.5, steps * height - 0.5))
    pixels = np.stack([x, y], 1)
    return view.to_frame(pixels[sample(view.beyond, pixels) == 0])
