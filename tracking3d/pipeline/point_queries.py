"""Points that are followed while an object is tracked: the queries, and their positions in each frame's estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.explain import a_kind, format_value
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.frames import Frame
from tracking3d.pipeline.session import Session
from tracking3d.points.answers import PointAnswers
from tracking3d.points.image_only import UncoveredPoints
from tracking3d.points.online import CausalPoints
from tracking3d.points.pictures import open_picture
from tracking3d.points.view import open_view

Array = NDArray[np.float64]


def validate_queries(follow: Any) -> Array | None:
    """Points to follow as ``(N, 3)`` rows of frame, x and y; frame is -1 for that in which the object is given.

    Args:
        follow: ``(N, 2)`` pixels, or ``(N, 3)`` with the index of a frame before them; None for none.

    Raises:
        InputError: If they are anything else.
    """
    if follow is None:
        return None
    try:
        queries = np.asarray(follow, dtype=np.float64)
    except (TypeError, ValueError):
        queries = np.zeros(0)
    if queries.ndim != 2 or queries.shape[1] not in (2, 3) or not len(queries):
        raise InputError(
            f"follow={format_value(follow)} is {a_kind(follow)} that does not hold points; give (x, y) of each in "
            "pixels, or (frame, x, y)."
        )
    if not np.isfinite(queries).all():
        raise InputError(
            "follow= has values that are no finite numbers; give (x, y) or (frame, x, y) of each point."
        )
    if queries.shape[1] == 2:
        return np.insert(queries, 0, -1.0, axis=1)
    if (queries[:, 0] < 0).any() or (queries[:, 0] % 1).any():
        wrong = queries[(queries[:, 0] < 0) | (queries[:, 0] % 1 != 0)][0, 0]
        raise InputError(f"follow= asks in frame {wrong:g}, which is no index; frames count from 0.")
    return queries


class PointFollowing:
    """Follows points through the frames of a session as they are estimated.

    Args:
        queries: See `validate_queries`.
    """

    def __init__(self, queries: Array) -> None:
        self._queries = queries
        self._asked: dict[int, CausalPoints] = {}
        self._uncovered: dict[int, UncoveredPoints] = {}
        self._size: tuple[int, int] | None = None
        self._surface: tuple[Array, NDArray[np.int64]] | None = None

    def step(self, session: Session, frame: Frame, estimate: FrameEstimate) -> FrameEstimate:
        """The estimate with its points; those that it revises get theirs again as far back as views are stored.

        Raises:
            InputError: If a point is asked for outside the frame.
        """
        if self._size is None:
            self._begin(frame)
        poses = {one.index: (one.camera or session.camera, one.T_cam_obj) for one in estimate.revised}
        if self._surface is None or poses or estimate.keyframe:
            model = session.result()
            self._surface = np.asarray(model.vertices, np.float64), np.asarray(model.faces)
            for group in self._asked.values():
                group.redrawn(poses.get, *self._surface)
        vertices, faces = self._surface
        radius = float(np.linalg.norm(np.ptp(vertices, axis=0))) / 2
        earlier: dict[int, PointAnswers] = {}
        if poses:
            for number, group in self._asked.items():
                for index, answer in group.again(radius).items():
                    into = earlier.setdefault(index, PointAnswers.unknown(len(self._queries)))
                    self._place(into, number, self._complete(number, index, answer))
        view = None
        if estimate.status is not Status.LOST:
            camera = estimate.camera or session.camera
            view = open_view(frame.image, estimate.mask, camera, estimate.T_cam_obj, vertices, faces)
        points = PointAnswers.unknown(len(self._queries))
        for number in sorted(set(self._queries[:, 0].astype(int))):
            if number == frame.index and number not in self._asked:
                self._asked[number] = CausalPoints(self._queries[self._queries[:, 0] == number, 1:])
            if number in self._asked:
                group = self._asked[number]
                answer = group.step(frame.index, view, radius)
                self._follow_uncovered(number, group, frame, estimate)
                self._place(points, number, self._complete(number, frame.index, answer))
        revised = tuple(replace(one, points=earlier.get(one.index)) for one in estimate.revised)
        return replace(estimate, points=points, revised=revised)

    def _follow_uncovered(
        self, number: int, group: CausalPoints, frame: Frame, estimate: FrameEstimate
    ) -> None:
        """Follow what no surface covers into a frame; the points were asked for in frame ``number``."""
        if number not in self._uncovered:
            picture = open_picture(frame.image, estimate.mask)
            self._uncovered[number] = UncoveredPoints(frame.index, picture, group.xy, group.on_surface())
        elif uncovered := self._uncovered[number]:
            uncovered.step(frame.index, open_picture(frame.image, estimate.mask))

    def _complete(self, number: int, index: int, estimate: PointAnswers) -> PointAnswers:
        uncovered = self._uncovered.get(number)
        return (
            uncovered.complete(index, estimate, self._asked[number].on_surface()) if uncovered else estimate
        )

    def _begin(self, first: Frame) -> None:
        self._size = first.size
        self._queries = self._queries.copy()
        self._queries[self._queries[:, 0] < 0, 0] = first.index
        height, width = first.size
        x, y = self._queries[:, 1], self._queries[:, 2]
        outside = ~((x > -0.5) & (y > -0.5) & (x < width - 0.5) & (y < height - 0.5))
        if outside.any():
            _, x0, y0 = self._queries[outside][0]
            raise InputError(
                f"follow= asks for the pixel {x0:g},{y0:g}, but frames have {width} x {height} counted from 0."
            )

    def _place(self, into: PointAnswers, number: int, estimate: PointAnswers) -> None:
        rows = self._queries[:, 0] == number
        for name in ("positions", "visible", "uncertainty", "points", "measured"):
            getattr(into, name)[rows] = getattr(estimate, name)
