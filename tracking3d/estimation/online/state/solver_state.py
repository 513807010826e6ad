"""The online solver's state: the object's map, and where it was seen last."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.optimization.revolution import FreeAxis
from tracking3d.estimation.online.state.confidence import LossBaseline
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.segmentation import ColourModels
from tracking3d.estimation.segmentation.online_motion_cue import MotionReference
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import Surface
from tracking3d.runtime.background_attempt import BackgroundAttempt
from tracking3d.scene.view import FrameCrop

MOST_WAITING = 40
"""Most frames that are kept with their estimates because their poses may come or change later."""


@dataclass(frozen=True)
class MaskAgreement:
    """How far the initial masks of the keyframes agree with each other."""

    weight: float = 0.0  # of initial masks because of that, in [0, 1]
    beyond: float = 0.0  # median share of a keyframe's initial mask that lies beyond its silhouette
    keyframes: int = 0  # how many there were when that was measured


@dataclass(frozen=True, eq=False)
class InactiveMap:
    """A map that the object is not tracked against now; its transform to the active map is unknown."""

    object_map: ObjectMap  # the map
    surface: Surface  # its surface
    baseline: LossBaseline  # the losses of the frames that were tracked against it
    spans: tuple[tuple[int, int], ...]  # first and last index of the frames that were estimated with it
    unaligned: bool  # whether its transform to the first map is only a guess
    mask_agreement: MaskAgreement = MaskAgreement()  # that of its keyframes


@dataclass(frozen=True, eq=False)
class _AnyState:
    """What the solver knows between two frames, with or without a map."""

    camera: Camera  # the camera of the video
    object_map: ObjectMap  # the object's map; before the first one, what the pending frames are compared by
    last_pose: tuple[Pose, int]  # pose and index of the last frame, also if the object was lost in it
    grey: NDArray[np.uint8]  # (H, W) the last frame
    tracked_points: FollowedPoints  # points in the last frame
    # the projection of the encoder's features; None leaves them as they are
    feature_space: FeatureSpace | None = None
    # poses (4, 4) that frames are refined from in place of their causal ones, by frame index
    extended: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    # the map that is computed in another thread, if there is one; see `tracking3d.estimation.online.initializer`
    background: BackgroundAttempt[Any, tuple[Keyframe, FrameEstimate], FrameEstimate] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Initializing(_AnyState):
    """Frames are collected until they show enough motion for a first map."""

    # the frames that wait for the first map, with their estimates so far
    pending: tuple[tuple[Keyframe, FrameEstimate], ...] = ()
    # frames before the pending ones, in which the object did not turn yet; the first map gives them a pose
    rested: tuple[tuple[Keyframe, FrameEstimate], ...] = ()
    next_attempt: float = 0.0  # the motion at which the next initialization is tried
    # how many frames the last initialization had if it was ambiguous; 0 if there was none
    ambiguous_frames: int = 0
    # (3,) the object's rotation in that initialization as a rotation vector, or None
    ambiguous_rotation: NDArray[np.float64] | None = None
    waiting_reason: str = ""  # why the initialization waits, if not for motion
    needs_points: bool = False  # whether a map without points is of no use, as beside another map


@dataclass(frozen=True, eq=False, kw_only=True)
class Mapped(_AnyState):
    """The object is tracked against its map, or was lost, see `lost`."""

    surface: Surface  # the map's surface, as poses are fitted to it
    # pose and index of the frame before the last one; None if no motion is known
    previous_pose: tuple[Pose, int] | None = None
    baseline: LossBaseline = field(default_factory=LossBaseline)  # the losses of tracked frames
    # how many frames in a row the object has been lost; those without a mask, in which no hypothesis can be
    # tried, count as one
    lost_frames: int = 0
    doubtful_frames: int = 0  # how many frames in a row have been lost or of low confidence
    misfits: int = 0  # how many frames in a row a map without points has explained worse than its first ones
    restarts: int = 0  # how often the map was restarted for that
    tried: int = 0  # frames that were shown to an inactive map, to a second one, or to a restarted one
    # the best pose of the last frame, if that had a mask and the pose was rejected
    last_candidate: Pose | None = None
    # poses and indices of the last tracked frames, for the motion model
    trajectory: tuple[tuple[Pose, int], ...] = ()
    colours: ColourModels | None = None  # colours of object and background in tracked frames
    motion_references: tuple[MotionReference, ...] = ()  # the last tracked frames, for the motion cue
    # a second initialization, which goes on while the object is lost and has a mask
    reinitialization: Initializing | None = None
    inactive_maps: tuple[InactiveMap, ...] = ()  # the other maps of the object
    # first and last index of the earlier frames that were estimated with the active map
    spans: tuple[tuple[int, int], ...] = ()
    active_since: int = -1  # index of the frame from which the active map has been active
    unaligned: bool = False  # whether the transform from the active map to the first one is only a guess
    # how many keyframes there were, and how many degrees they spanned, when a depth reversal was last tried
    reversal_attempt: tuple[int, float] = (0, 0.0)
    # how far the initial masks of the keyframes agree with each other
    mask_agreement: MaskAgreement = MaskAgreement()
    # Frames of a map without points, at most `MOST_WAITING`, evenly spaced; if it is restarted, they are
    # estimated with the new map. Empty if it cannot be restarted.
    revisable: tuple[tuple[Keyframe, FrameEstimate], ...] = ()
    # the map as it was, and its refinement by dense landmarks in another thread; None if there is none
    refinement: tuple[ObjectMap, BackgroundAttempt[Any, Any, Any]] | None = None

    @cached_property
    def followed(self) -> list[tuple[NDArray[np.uint8], Pose, FollowedPoints]]:
        """The last image `pose_tracking.follow_points` saw, and its result: frames with carried masks ask twice."""
        return []

    @property
    def lost(self) -> bool:
        """Whether the object was lost in the last frame: it is relocalized, or a second map is initialized."""
        return self.lost_frames > 0

    def with_map(self, object_map: ObjectMap, **changes: Any) -> Mapped:
        """The state with another map and its surface, and with further changes."""
        return replace(self, object_map=object_map, surface=object_map.surface(), **changes)

    def moved(self, object_map: ObjectMap, move: Callable[[Pose], Pose], **changes: Any) -> Mapped:
        """The state with a map in other coordinates, which ``move`` takes the last poses to."""

        def there(at: tuple[Pose, int]) -> tuple[Pose, int]:
            return move(at[0]), at[1]

        changes = {
            "last_pose": there(self.last_pose),
            "previous_pose": self.previous_pose and there(self.previous_pose),
            "trajectory": tuple(map(there, self.trajectory)),
            "motion_references": (),
            **changes,
        }
        return self.with_map(object_map, **changes)


SolverState = Initializing | Mapped
"""What the solver knows between two frames: the type is its phase."""


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
    Initializing,
    Mapped,
    ColourModels,
    MotionReference,
    ObjectMap,
    Keyframe,
    Surface,
    FollowedPoints,
    Keypoints,
    LossBaseline,
    FrameCrop,
    FreeAxis,
)
"""The classes that a `SolverState` consists of, besides `tracking3d.estimation.solver.STATE_CLASSES`."""
