"""The protocol of solvers: state machines from frames and rough masks to estimates.

``init`` starts on the first frame, ``step`` takes each further one, ``result`` gives the object. Failure is
data: a frame that cannot be estimated is answered with a status and a reason, never with an exception.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Generic, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.gap import Gap, ModelCoverage, PhotoEstimates, PhotoSet
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.refined_start import RefinedStart
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
    """A solver that can look at a whole video once more, when it has ended."""

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


@runtime_checkable
class ContinuingSolver(Protocol, Generic[State]):
    """A refining solver that can start from an earlier refinement, of which most frames keep their estimates."""

    def continue_refinement(self, state: State, start: RefinedStart) -> State | None:
        """The state for ``refine_frame`` and ``result``, in place of ``refine``; None if it does not fit ``start``."""
        ...

    def keep_frame(self, state: State, frame: Frame, T_cam_obj: NDArray[np.float64]) -> State:
        """Take a frame whose refined pose ``(4, 4)`` stands, before ``refine_frame`` takes the next one."""
        ...

    def keyframe_poses(self, state: State) -> Mapping[int, NDArray[np.float64]]:
        """Refined poses ``(4, 4)`` of the keyframes after ``refine``, by frame index; none if they do not tell how the
        refinement moved the causal poses."""
        ...


@runtime_checkable
class ExtendingSolver(Protocol, Generic[State]):
    """A refining solver that can track the object into frames that were not explained, before it refines everything."""

    def begin_extension(
        self, state: State, confidence: Mapping[int, float]
    ) -> tuple[State, ModelCoverage] | None:
        """The state for ``extend``, and what the model explains; None if there is nothing to start from.

        Args:
            state: After the last frame.
            confidence: Of the causal estimate of each frame, by index, with the model that it was made with.
        """
        ...

    def extend(self, state: State, gap: Gap) -> tuple[State, list[FrameEstimate]]:
        """Track the object through a gap, and learn from it; the gap's anchor is one of ``ModelCoverage.anchors``."""
        ...

    def end_extension(self, state: State, found: Collection[int], last: int) -> State:
        """The state for ``refine``.

        Args:
            state: After the last gap.
            found: Indices of the frames of gaps in which the object was found.
            last: Index of the last frame of the video.
        """
        ...

    def start_from(self, state: State, poses: Mapping[int, NDArray[np.float64]]) -> State:
        """The state that refines frames from other poses ``(4, 4)`` than the causal ones, by frame index."""
        ...


@runtime_checkable
class PhotoSolver(Protocol, Generic[State]):
    """A solver that can start from photos, whatever their order and the turn between them."""

    def has_points(self, state: State, ended: bool) -> bool:
        """Whether there is a map with points after the last frame; if it has ``ended``, also one made only then."""
        ...

    def start_from_photos(self, state: State, photos: PhotoSet) -> tuple[State, PhotoEstimates]:
        """The state for ``refine`` with a map of the photos, in place of any that there is.

        If the photos cannot be joined, it is the same state, which knows the reason.
        """
        ...


@runtime_checkable
class LiveSolver(Protocol, Generic[State]):
    """A solver that can do long work in another thread, so that a live source's frames do not wait for it."""

    def for_live_source(self) -> Self:
        """The same solver for a live source; the result then depends on how fast the machine is."""
        ...

    def finish_background_work(self, state: State) -> tuple[State, FrameEstimate | None]:
        """Wait for what is still computed in other threads.

        Returns:
            The state with its result, and an estimate of the last frame with those of earlier frames in ``revised``;
            None if there is nothing new.
        """
        ...


@runtime_checkable
class GuidedSolver(Protocol, Generic[State]):
    """A solver that goes on as the user says: backwards from the first frame, and by a mask that is right."""

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
