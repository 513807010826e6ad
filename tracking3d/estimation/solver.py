"""The protocol of solvers: state machines from frames and rough masks to estimates.

``init`` starts on the first frame, ``step`` takes each further one, ``result`` gives the object. Failure is
data: a frame that cannot be estimated is answered with a status and a reason, never with an exception.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.shape import Shape
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import BackProjection, TexelMap
from tracking3d.runtime.stage_times import StageTimes

State = TypeVar("State")

STATE_CLASSES: tuple[type, ...] = (
    BackProjection,
    Camera,
    FeatureSpace,
    FrameEstimate,
    MaskSource,
    Observation,
    Pose,
    Shape,
    StageTimes,
    Status,
    TexelMap,
    Window,
)
"""Of what states are made; a solver that names all of its classes in ``state_classes`` can be resumed."""


class Solver(Protocol, Generic[State]):
    """Estimates shape, texture and poses causally; all memory is in the state it hands back."""

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[State, FrameEstimate]:
        """Start on the first frame; its mask is given."""
        ...

    def step(self, state: State, frame: Frame, mask: MaskEstimate) -> tuple[State, FrameEstimate]:
        """Take one more frame."""
        ...

    def result(self, state: State) -> ObjectModel:
        """The object as it is known now."""
        ...


@runtime_checkable
class RefiningSolver(Protocol, Generic[State]):
    """A solver that can look at a whole video once more, when it has ended, and goes on as the user says.

    What has an answer here need not be implemented: it then cannot be done, or nothing has to be.
    """

    def refine(self, state: State) -> State:
        """Solve everything once more over all keyframes; the state is then for ``refine_frame`` and ``result`` only."""
        ...

    def refine_frame(
        self, state: State, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[State, FrameEstimate]:
        """The pose of a frame once more, against the final object; frames come in order of time.

        Args:
            state: From ``refine``, then from the last call.
            frame: The frame.
            mask: Its initial mask as it was.
            T_cam_obj: ``(4, 4)`` the causal estimate.
        """
        ...

    def restart_backwards(
        self, state: State, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]
    ) -> State:
        """Go on from a frame seen before; the frames that follow come from before it, numbered after ``number``.

        Args:
            state: After the last frame.
            frame: The frame to go on from.
            number: The index that the last frame had.
            T_cam_obj: ``(4, 4)`` the estimate for ``frame``.
        """
        ...

    def trust_mask(self, state: State, frame: Frame, mask: NDArray[np.bool_]) -> State:
        """The state before ``step`` takes a frame whose mask ``(H, W)`` the user has given."""
        ...

    def carry_mask(self, state: State, frame: Frame, mask: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """The mask ``(H, W)`` of the last frame, moved into ``frame`` as the object moves; None if that is unknown."""
        return None

    def continue_refinement(self, state: State, start: RefinedStart) -> State | None:
        """The state for ``refine_frame`` and ``result`` from an earlier refinement, of which most frames keep their
        estimates, in place of ``refine``; None if it does not fit ``start``."""
        return None

    def keep_frame(self, state: State, frame: Frame, T_cam_obj: NDArray[np.float64]) -> State:
        """Take a frame whose refined pose ``(4, 4)`` stands, before ``refine_frame`` takes the next one."""
        return state

    def keyframe_poses(self, state: State) -> Mapping[int, NDArray[np.float64]]:
        """Refined poses ``(4, 4)`` of the keyframes after ``refine``, by frame index; none if they do not tell how the
        refinement moved the causal poses."""
        return {}

    def begin_extension(
        self, state: State, confidence: Mapping[int, float]
    ) -> tuple[State, ModelCoverage] | None:
        """The state for ``extend``, which tracks the object into frames that were not explained, before everything is
        refined, and what the model explains; None if there is nothing to start from.

        Args:
            state: After the last frame.
            confidence: Of the causal estimate of each frame, by index, with the model that it was made with.
        """
        return None

    def extend(self, state: State, gap: Gap) -> tuple[State, list[FrameEstimate]]:
        """Track through a gap, whose anchor is one of ``ModelCoverage.anchors``, and learn; estimates without masks."""
        return state, []

    def end_extension(self, state: State, found: Collection[int], last: int) -> State:
        """The state for ``refine``.

        Args:
            state: After the last gap.
            found: Indices of the frames of gaps in which the object was found.
            last: Index of the last frame of the video.
        """
        return state

    def start_from(self, state: State, poses: Mapping[int, NDArray[np.float64]]) -> State:
        """The state that refines frames from other poses ``(4, 4)`` than the causal ones, by frame index."""
        return state

    def has_points(self, state: State, ended: bool) -> bool:
        """Whether there is a map with points after the last frame; if it has ``ended``, also one made only then."""
        return True

    def start_from_photos(self, state: State, photos: PhotoSet) -> tuple[State, PhotoEstimates]:
        """The state for ``refine`` with a map of photos, whatever their order and the turn between them, in place of
        any that there is.

        If the photos cannot be joined, it is the same state, which knows the reason.
        """
        return state, PhotoEstimates((), "")

    def for_live_source(self) -> Self:
        """The solver that does long work in another thread, so that a live source's frames do not wait for it; the
        result then depends on how fast the machine is."""
        return self

    def finish_background_work(self, state: State) -> tuple[State, FrameEstimate | None]:
        """Wait for what is still computed in other threads.

        Returns:
            The state with its result, and an estimate of the last frame with those of earlier frames in ``revised``;
            None if there is nothing new.
        """
        return state, None


@dataclass(frozen=True)
class ModelCoverage:
    """The part of a video that a model explains."""

    confidence: Mapping[int, float]  # of each frame that was estimated with it, by index
    anchors: frozenset[int]  # keyframes of which the pose is reliable: the object can be tracked from there


@dataclass(frozen=True, eq=False)
class Gap:
    """Consecutive frames, some of which the object's model does not explain, next to a keyframe."""

    anchor: Frame  # the keyframe's frame
    # the frames with their initial masks, the nearest to anchor first; they can be iterated once
    frames: Iterable[tuple[Frame, MaskEstimate]]
    backwards: bool  # whether they come before anchor


@dataclass(frozen=True)
class PhotoSet:
    """Frames as photos, which need not follow each other closely; ``read`` gives some, as often as it is called."""

    indices: tuple[int, ...]  # of those in which the object was seen, in order
    read: Callable[[Collection[int]], Iterator[tuple[Frame, MaskEstimate]]]


@dataclass(frozen=True, eq=False)
class PhotoEstimates:
    """What a solver makes of a set of photos."""

    estimates: tuple[FrameEstimate, ...]  # with the map of those that were joined; empty if there is none
    reason: str  # which photos are not joined, and what to do about that; empty if all are


_Pose = NDArray[np.float64]
LEAST_FRAMES = 4
"""Frames whose estimates stay; with fewer, nothing is known of how the refinement moved the object."""


@dataclass(frozen=True, eq=False)
class RefinedStart:
    """Poses and surface as a final refinement left them, to be continued with causal estimates of some other frames.

    The refinement may have rotated and scaled the object and changed the focal length; frames whose estimates stay have
    both poses, which tell how a causal pose is to be changed.
    """

    camera: Camera  # the camera of the refined poses
    vertices: NDArray[np.float64]  # (V, 3) the refined surface, with the topology of the solver's
    refined: Mapping[int, _Pose]  # (4, 4) refined poses by frame index, of at least `LEAST_FRAMES` frames
    causal: Mapping[int, _Pose]  # the same frames' causal poses
    focal: Mapping[int, float]  # the focal length in pixels that each causal pose belongs to

    @cached_property
    def scale(self) -> float:
        """Length of a causal unit in refined units."""
        depths = [
            (self.refined[index][2, 3], self.causal[index][2, 3] * self.camera.fx / self.focal[index])
            for index in self.refined
        ]
        return float(np.median([after / before for after, before in depths]))

    @cached_property
    def _indices(self) -> list[int]:
        return sorted(self.refined)

    def predict(self, index: int, T_cam_obj: _Pose, focal: float) -> _Pose:
        """The refined pose ``(4, 4)`` that a causal one amounts to: by the frame nearest in time.

        Args:
            index: Index of the frame.
            T_cam_obj: ``(4, 4)`` its causal pose.
            focal: The focal length in pixels that this belongs to.
        """
        if index in self.refined:
            return self.refined[index]
        after = bisect(self._indices, index)
        around = self._indices[max(after - 1, 0) : after + 1]
        nearest = min(around, key=lambda one: abs(one - index))
        there = self._scaled(self.causal[nearest], self.focal[nearest])
        return self._scaled(T_cam_obj, focal) @ np.linalg.inv(there) @ self.refined[nearest]

    def _scaled(self, T_cam_obj: _Pose, focal: float) -> _Pose:
        """A causal pose in refined units and with the refined focal length, under which the object keeps its size."""
        T = T_cam_obj.copy()
        T[:3, 3] *= self.scale
        T[2, 3] *= self.camera.fx / focal
        return T
