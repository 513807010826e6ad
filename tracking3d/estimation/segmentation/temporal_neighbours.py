"""Frames in order of time, each with the neighbours in which object and background motion differ enough."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.segmentation.motion_cue import Target, background_motion, flow_distance, small_grey
from tracking3d.geometry.camera import Camera
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import ObjectView

STEPS = (1, 2, 3, 5, 8)
"""Frames on either side that are tried, one after the other."""
REACH = STEPS[-1]
_ENOUGH = 4.0  # frame pixels that the motions are apart, from which on the nearest frame will do


@dataclass(frozen=True, eq=False)
class _Link:
    frame: ObjectView
    grey: NDArray[np.uint8]
    to_next: NDArray[np.float64] | None = None


class TemporalNeighbours:
    """The latest frames; what is asked about one waits until those after it are there.

    The background is followed from frame to frame; further steps are put together.
    """

    def __init__(self, links: Iterable[_Link] = ()) -> None:
        self._links = deque(links, maxlen=2 * REACH + 1)

    def as_it_is(self) -> TemporalNeighbours:
        """The frames that are known now; what is added later is not."""
        return TemporalNeighbours(self._links)

    def add(self, frame: ObjectView) -> None:
        """The next frame; frames further back than twice `REACH` are forgotten."""
        grey = small_grey(frame.image)
        if self._links and self._links[-1].grey.shape == grey.shape:
            last = self._links.pop()
            hidden = last.frame.initial | last.frame.mask
            self._links.append(_Link(last.frame, last.grey, background_motion(last.grey, grey, hidden)))
        self._links.append(_Link(frame, grey))

    def around(self, index: int, scene: Drawn, camera: Camera) -> list[Target]:
        """The nearest frame on either side of frame ``index`` at which the motions part; the farthest if none does."""
        if not np.isfinite(scene.T_cam_obj).all():
            return []
        (place,) = (at for at, link in enumerate(self._links) if link.frame.index == index)
        return [found for side in (-1, 1) if (found := self._beside(place, side, scene, camera))]

    def _beside(self, place: int, side: int, scene: Drawn, camera: Camera) -> Target | None:
        H, found, at = np.eye(3), None, place
        for step in STEPS:
            while at != place + side * step:
                link = at if side > 0 else at - 1
                if not (link >= 0 and at + side < len(self._links)):
                    return found
                to_next = self._links[link].to_next
                if to_next is None:
                    return found
                H = (to_next if side > 0 else np.linalg.inv(to_next)) @ H
                at += side
            frame = self._links[at].frame
            if np.isfinite(frame.T_cam_obj).all():
                found = frame.image, frame.T_cam_obj, H
                if flow_distance(scene, camera, found) >= _ENOUGH:
                    return found
        return found
