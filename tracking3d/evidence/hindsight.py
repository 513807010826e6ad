"""Masks answered once more when the whole video is known: what most frames call object is object in all.

The frames are gone through twice. The first time, masks and poses that are believed are put together: a hull of their
masks, and the colours of object and surroundings. The second time each pixel is weighed, with the frames around it in
time telling which motion it has.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.evidence.colours import Colours, as_lab
from tracking3d.evidence.consensus import Consensus
from tracking3d.evidence.decision import along_edges, pasted, tidied
from tracking3d.evidence.hindsight_weights import WEIGHTS
from tracking3d.evidence.motion import motion_cue
from tracking3d.evidence.order import REACH, InOrder
from tracking3d.evidence.scene import Answered, FrameWindow, Mask, Plane
from tracking3d.evidence.sources import Said
from tracking3d.geometry.camera import Camera
from tracking3d.side_by_side import InTurn

MOST_VIEWS = 60
"""Frames that are put together, spread over those that are believed."""
_BELIEVED = 0.5
_ASKED = 0.4
"""How far the image smooths what is said, see `along_edges`: in an even one outlines would creep."""
_AT_A_TIME = 2
"""Frames that are decided at a time, in as many threads as OpenCV may take at most."""
_MOST_CHANGE = 0.35  # of the union of both masks; a mask that changes more is another object's


@dataclass(frozen=True, eq=False)
class Decided:
    """What came of a frame.

    Attributes:
        index: Of the frame.
        mask: ``(H, W)``.
        probability: ``(H, W)`` of the object; the mask is where it is above a half.
    """

    index: int
    mask: Mask
    probability: Plane


class Hindsight:
    """All frames of a video, with their masks and poses.

    Args:
        camera: Of the frames, without a lens.
        vertices: ``(V, 3)`` of the object.
        faces: ``(F, 3)``.
        confidences: Of the frames that have a pose, by index.

    Attributes:
        order: The latest frames of the second time.
    """

    def __init__(
        self,
        camera: Camera,
        vertices: NDArray[np.float64],
        faces: NDArray[np.int64],
        confidences: dict[int, float],
    ) -> None:
        self._camera, self._vertices, self._faces = camera, vertices, faces
        chosen = sorted(index for index, confidence in confidences.items() if confidence >= _BELIEVED)
        chosen = chosen or sorted(confidences)
        places = np.linspace(0, len(chosen) - 1, min(MOST_VIEWS, len(chosen))).round().astype(int)
        self._wanted = {chosen[place] for place in places}
        self._consensus = Consensus(vertices)
        self._colours: Colours | None = None
        self.order, self._waiting = InOrder(), deque[Answered]()
        self._jobs: InTurn | None = None

    def wants(self, index: int) -> bool:
        """Whether a frame is one of those that are put together; `see` passes the others over."""
        return index in self._wanted

    def see(self, frame: Answered) -> None:
        """A frame for the first time."""
        if not self.wants(frame.index) or not np.isfinite(frame.T_cam_obj).all():
            return
        scene = self._scene(frame)
        if scene is not None and scene.answer.any():
            self._consensus.see(scene)
            self._colours = Colours.of(as_lab(scene.image), scene.answer, self._colours)

    def settle(self) -> None:
        """All frames were seen a first time."""
        self._consensus.settle()

    def decide(self, frame: Answered) -> Iterator[tuple[int, Decided | None]]:
        """A frame for the second time.

        Args:
            frame: The next one, in the order of time.

        Yields:
            Indices of earlier frames whose turn has come, with what is decided; None where the answer stands.
        """
        self.order.add(frame)
        self._waiting.append(frame)
        if len(self._waiting) > REACH:
            yield from self._begin(self._waiting.popleft())

    def rest(self) -> Iterator[tuple[int, Decided | None]]:
        """Those that are left when there are no more frames; see `decide`."""
        while self._waiting:
            yield from self._begin(self._waiting.popleft())
        if self._jobs is not None:
            yield from self._jobs.rest()

    def said(self, frame: Answered, order: InOrder | None = None) -> tuple[FrameWindow, Said] | None:
        """What the sources say of one of the latest frames; None where it has no masks or no pose.

        Args:
            frame: The frame.
            order: Those around it; `order` as it is, if left out.
        """
        if not frame.initial.any() or not frame.answer.any() or not np.isfinite(frame.T_cam_obj).all():
            return None
        scene = self._scene(frame)
        if scene is None or not scene.initial.any() or not scene.answer.any():
            return None
        around = (order or self.order).around(frame.index, scene, self._camera)
        motion = motion_cue(scene, self._camera, around)
        return scene, Said.of(scene, self._consensus.drawn(scene), self._colours, motion)

    def _scene(self, frame: Answered) -> FrameWindow | None:
        return FrameWindow.of(frame, self._camera, self._vertices, self._faces)

    def _begin(self, frame: Answered) -> Iterator[tuple[int, Decided | None]]:
        if self._jobs is None:  # as many threads as there are where frames are decided
            self._jobs = InTurn(min(cv2.getNumThreads(), _AT_A_TIME))
        yield from self._jobs.do(partial(self._decided, frame, self.order.as_it_is()))

    def _decided(self, frame: Answered, order: InOrder) -> tuple[int, Decided | None]:
        asked = self.said(frame, order)
        if asked is None:
            return frame.index, None
        scene, said = asked
        support = tidied(along_edges(scene.image, said.log_odds(WEIGHTS), _ASKED))
        support = np.where(scene.valid, support, -1).astype(np.float32)
        full = pasted(support, scene.window, np.full(frame.answer.shape, -1, np.float32))
        mask = full > 0
        common, either = (
            np.count_nonzero(way(mask, frame.answer)) for way in (np.logical_and, np.logical_or)
        )
        if common < (1 - _MOST_CHANGE) * either:
            return frame.index, None
        return frame.index, Decided(frame.index, mask, 0.5 + 0.5 * full)


def all_decided(hindsight: Hindsight, frames: Iterable[Answered]) -> Iterator[tuple[int, Decided | None]]:
    """Every frame of a video whose frames were all seen once, in their order."""
    for frame in frames:
        yield from hindsight.decide(frame)
    yield from hindsight.rest()
