"""Points of the object that its surface does not cover yet, tracked in the images until it does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.points.answers import PointAnswers
from tracking3d.points.image_following import ImageAnswers, ImageFollower
from tracking3d.points.online import KEPT
from tracking3d.points.pictures import Picture
from tracking3d.points.view import Array


class UncoveredPoints:
    """The points of one question that lay on the object's mask and on no surface then.

    Args:
        index: The index of the frame of the question.
        picture: That frame.
        xy: ``(N, 2)`` pixels of all points that were asked for in it.
        on_surface: ``(N,)`` which of them the surface covers.
    """

    def __init__(self, index: int, picture: Picture, xy: Array, on_surface: NDArray[np.bool_]) -> None:
        self._mine = np.flatnonzero(~on_surface & (picture.depth_in_mask(xy) > 0))
        self._told: dict[int, ImageAnswers] = {}
        self._follower: ImageFollower | None = None
        if len(self._mine):
            self._follower = ImageFollower(index, picture, xy[self._mine])
            self._told[index] = self._follower.first()

    def __bool__(self) -> bool:
        """Whether there are any."""
        return self._follower is not None

    def step(self, index: int, picture: Picture) -> None:
        """Follow them into the next frame."""
        if self._follower is not None:
            self._told[index] = self._follower.step(index, picture)
            self._told = dict(list(self._told.items())[-KEPT:])

    def complete(self, index: int, estimates: PointAnswers, on_surface: NDArray[np.bool_]) -> PointAnswers:
        """The answers for a frame, with those of the images for points that the surface still does not cover.

        Args:
            index: The index of the frame.
            estimates: Of all points of the question, by the surface.
            on_surface: ``(N,)`` which of them it covers by now.
        """
        told = self._told.get(index)
        if told is None:
            return estimates
        alone = ~on_surface[self._mine]
        points = self._mine[alone]
        completed = replace(
            estimates,
            positions=estimates.positions.copy(),
            visible=estimates.visible.copy(),
            uncertainty=estimates.uncertainty.copy(),
            measured=estimates.measured.copy(),
        )
        completed.positions[points], completed.visible[points] = told.positions[alone], told.visible[alone]
        completed.uncertainty[points], completed.measured[points] = (
            told.uncertainty[alone],
            told.visible[alone],
        )
        return completed
