"""The online solver's state: the object's map, and where it was seen last."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.state.confidence import LossBaseline
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.points.view import GreyWindow
from tracking3d.rendering import Surface
from tracking3d.runtime.background_attempt import BackgroundAttempt
from tracking3d.segmentation import ColourModels
from tracking3d.segmentation.online_motion_cue import MotionReference

MOST_WAITING = 40
"""Most frames that are kept with their estimates because their poses may come or change later."""


class SolverPhase(Enum):
    """What the solver does with the next frame."""

    INITIALIZING = auto()
    """It collects pending frames until they show enough motion for a first map."""
    TRACKING = auto()
    """It tracks the object against the map."""
    LOST = auto()
    """It relocalizes the object, or initializes a second map."""


@dataclass(frozen=True)
class MaskAgreement:
    """How far the initial masks of the keyframes agree with each other.

    Attributes:
        weight: Of initial masks because of that, in [0, 1].
        beyond: Median share of a keyframe's initial mask that lies beyond its silhouette.
        keyframes: How many there were when that was measured.
    """

    weight: float = 0.0
    beyond: float = 0.0
    keyframes: int = 0


@dataclass(frozen=True, eq=False)
class InactiveMap:
    """A map that the object is not tracked against now; its transform to the active map is unknown.

    Attributes:
        object_map: The map.
        surface: Its surface.
        baseline: The losses of the frames that were tracked against it.
        spans: First and last index of the frames that were estimated with it.
        unaligned: Whether its transform to the first map is only a guess.
        mask_agreement: That of its keyframes.
    """

    object_map: ObjectMap
    surface: Surface
    baseline: LossBaseline
    spans: tuple[tuple[int, int], ...]
    unaligned: bool
    mask_agreement: MaskAgreement = MaskAgreement()


@dataclass(frozen=True, eq=False)
class SolverState:
    """What the solver knows between two frames.

    Attributes:
        camera: The camera of the video.
        object_map: The object's map.
        surface: The map's surface, as poses are fitted to it.
        last_pose: Pose and index of the last frame, also if the object was lost in it.
        previous_pose: The same of the frame before it; None if no motion is known.
        grey: ``(H, W)`` the last frame.
        tracked_points: Points in the last frame.
        pending: The frames that wait for the first map, with their estimates so far; None once there is a map.
        feature_space: The projection of the encoder's features; None leaves them as they are.
        next_attempt: The motion at which the next initialization is tried.
        ambiguous_frames: How many frames the last initialization had if it was ambiguous; 0 if there was none.
        ambiguous_rotation: ``(3,)`` the object's rotation in that initialization as a rotation vector, or None.
        waiting_reason: Why the initialization waits, if not for motion.
        baseline: The losses of tracked frames.
        lost_frames: How many frames in a row the object has been lost; those without a mask, in which no hypothesis can
            be tried, count as one.
        doubtful_frames: How many frames in a row have been lost or of low confidence.
        misfits: How many frames in a row a map without points has explained worse than its first ones.
        restarts: How often it was begun again for that.
        last_candidate: The best pose of the last frame, if that had a mask and the pose was rejected.
        trajectory: Poses and indices of the last tracked frames, for the motion model.
        colours: Colours of object and background in tracked frames.
        motion_references: The last tracked frames, for the motion cue.
        reinitialization: The state of a second initialization, which goes on while the object is lost and has a mask.
        inactive_maps: The other maps of the object.
        spans: First and last index of the earlier frames that were estimated with the active map.
        active_since: Index of the frame from which the active map has been active.
        unaligned: Whether the transform from the active map to the first one is only a guess.
        reversal_attempt: How many keyframes there were, and how many degrees they spanned, when a depth reversal was
            last tried.
        mask_agreement: How far the initial masks of the keyframes agree with each other.
        extended: Poses ``(4, 4)`` that were found when the largest map was extended over frames that it did not
            explain, by frame index.
        rested: Frames before the pending ones, in which the object did not turn yet; the first map gives them a pose.
        repeatable: Frames of a map without points, at most `MOST_WAITING`, evenly spaced; if it is begun again, they
            are estimated again. Empty if it cannot be.
        background: The initialization that is computed in another thread, if there is one; see
            `tracking3d.estimation.online.map_initialization`.
    """

    camera: Camera
    object_map: ObjectMap
    surface: Surface | None
    last_pose: tuple[Pose, int]
    previous_pose: tuple[Pose, int] | None
    grey: NDArray[np.uint8]
    tracked_points: FollowedPoints
    pending: tuple[tuple[Keyframe, FrameEstimate], ...] | None = ()
    feature_space: FeatureSpace | None = None
    next_attempt: float = 0.0
    ambiguous_frames: int = 0
    ambiguous_rotation: NDArray[np.float64] | None = None
    waiting_reason: str = ""
    baseline: LossBaseline = field(default_factory=LossBaseline)
    lost_frames: int = 0
    doubtful_frames: int = 0
    misfits: int = 0
    restarts: int = 0
    last_candidate: Pose | None = None
    trajectory: tuple[tuple[Pose, int], ...] = ()
    colours: ColourModels | None = None
    motion_references: tuple[MotionReference, ...] = ()
    reinitialization: SolverState | None = None
    inactive_maps: tuple[InactiveMap, ...] = ()
    spans: tuple[tuple[int, int], ...] = ()
    active_since: int = -1
    unaligned: bool = False
    reversal_attempt: tuple[int, float] = (0, 0.0)
    mask_agreement: MaskAgreement = MaskAgreement()
    extended: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    rested: tuple[tuple[Keyframe, FrameEstimate], ...] = ()
    repeatable: tuple[tuple[Keyframe, FrameEstimate], ...] = ()
    background: BackgroundAttempt[Any, tuple[Keyframe, FrameEstimate], FrameEstimate] | None = None

    @property
    def phase(self) -> SolverPhase:
        """Which phase the solver is in."""
        if self.pending is not None:
            return SolverPhase.INITIALIZING
        return SolverPhase.LOST if self.lost_frames else SolverPhase.TRACKING

    def advanced(
        self, pose: Pose, index: int, grey: NDArray[np.uint8], followed: FollowedPoints
    ) -> SolverState:
        """The state one frame later."""
        return replace(
            self, last_pose=(pose, index), previous_pose=self.last_pose, grey=grey, tracked_points=followed
        )


def thin_out(
    frames: tuple[tuple[Keyframe, FrameEstimate], ...],
) -> tuple[tuple[Keyframe, FrameEstimate], ...]:
    """At most `MOST_WAITING` of the frames: every second, with the first and the last, as long as there are more."""
    while len(frames) > MOST_WAITING:
        frames = (*frames[:-1:2], frames[-1])
    return frames


ONLINE_CLASSES = (
    InactiveMap,
    MaskAgreement,
    SolverState,
    ColourModels,
    MotionReference,
    ObjectMap,
    Keyframe,
    Surface,
    FollowedPoints,
    Keypoints,
    LossBaseline,
    GreyWindow,
)
"""The classes that a `SolverState` consists of, besides `tracking3d.estimation.solver.STATE_CLASSES`."""
