"""Estimates for a clip, from any method and in any format.

Frames are named by their index in the clip. None is what a method does not estimate; what it does estimate counts as
wrong in the frames that it has no estimate for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from tracking3d.estimation.estimate import MaskSource
from tracking3d.runtime.stage_times import StageTimes
from tracking3d_bench.datasets.truth import MaskReference

PointTracker = Callable[[int, ArrayLike], tuple[NDArray[np.float64], NDArray[np.bool_]]]
"""Follows the points ``(N, 2)`` of one frame: positions ``(T, N, 2)`` and visibility ``(T, N)`` in the frames of
the clip; NaN and False if there is no estimate."""


@dataclass(frozen=True, eq=False)
class Answers:
    """One method's estimates for one clip.

    Attributes:
        origin: The folder or file they come from, for messages.
        asked: Indices of the frames that the method was asked for; those it has no estimate for count as wrong.
        answered: Indices of the frames with any estimate.
        held: How many frames the method estimated, in the clip or not, if known.
        given: Index of the frame whose mask or box the method was given; it is not scored as a mask.
        masks: By frame index.
        initial_masks: What the mask tracker gave, by frame index.
        T_cam_obj: ``(4, 4)`` rigid, by frame index; without those that are not rigid.
        lost: Frames that the method called lost.
        confidence: In [0, 1] by frame index.
        seconds: Wall time by frame index.
        stages: The same stage by stage, if it was recorded.
        mask_sources: Origin of each estimated mask, if recorded.
        peak_memory_mb: Most memory held, in 10^6 bytes, if recorded.
        memory_growth_mb: How much more was held at most in the second half of the frames than in the first.
        mesh: Reads the estimated shape in object coordinates.
        points: Follows points.
        corrected_points: Follows points with the help of the images too.
        tracked: Frames that the method called tracked, if it says so.
        free_axes: ``(3,)`` unit vectors in estimated object coordinates, by frame index: the method says that rotation
            about them is not known.
        visible_masks: Without what is in front of the object, by frame index; None if the method cannot tell.
    """

    origin: Path
    asked: range
    answered: frozenset[int]
    held: int | None = None
    given: int | None = None
    masks: Mapping[int, MaskReference] | None = None
    initial_masks: Mapping[int, MaskReference] | None = None
    T_cam_obj: Mapping[int, NDArray[np.float64]] | None = None
    lost: frozenset[int] = frozenset()
    confidence: Mapping[int, float] = field(default_factory=dict)
    seconds: Mapping[int, float] = field(default_factory=dict)
    stages: Mapping[int, StageTimes] = field(default_factory=dict)
    mask_sources: Mapping[int, MaskSource] = field(default_factory=dict)
    peak_memory_mb: float | None = None
    memory_growth_mb: float | None = None
    mesh: Callable[[], trimesh.Trimesh] | None = None
    points: PointTracker | None = None
    corrected_points: PointTracker | None = None
    tracked: frozenset[int] | None = None
    visible_masks: Mapping[int, MaskReference] | None = None
    free_axes: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)

    def matched(self, frames: int) -> str:
        """Which frames are scored, in words.

        Args:
            frames: How many the clip has.
        """
        answered = sorted(self.answered)
        count = len(answered) if self.held is None else f"{len(answered)} of {self.held}"
        spread = f", {answered[0]} to {answered[-1]}" if answered else ""
        asked = f"; {len(self.asked)} were requested" if len(self.asked) != len(answered) else ""
        return f"{count} estimated frames match frames of the clip{spread} of its {frames}{asked}"
