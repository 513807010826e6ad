"""The online solver's state: the object's map, and where it was seen last."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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
from tracking3d.rendering import Surface
from tracking3d.segmentation import ColourModels
from tracking3d.segmentation.online_motion_cue import MotionReference


@dataclass(frozen=True, eq=False)
class InactiveMap:
    """An inactive map; its transform to the active map is unknown.

    Attributes:
        object_map: The map.
        surface: The map's surface.
        usual: What frames that were tracked against it have cost.
        spans: First and last index of the frames that it answered.
        guessed: Whether how it lies to the first map is a guess.
    """

    object_map: ObjectMap
    surface: Surface
    baseline: LossBaseline
    spans: tuple[tuple[int, int], ...]
    unaligned: bool


@dataclass(frozen=True, eq=False)
class SolverState:
    """What the solver knows between two frames.

    Attributes:
        camera: The camera of the video.
        object_map: The object's map.
        surface: The map's surface, as poses are fitted to it.
        last: Pose and index of the last frame, a lost one's included.
        before: The same of the frame before; None where there is no motion to go on with.
        grey: ``(H, W)`` the last frame.
        followed: Points in the last frame.
        waiting: First frames that wait for the start, with their answers so far; None once it is done.
        space: What is made of the encoder's features; None leaves them as they are.
        due: Motion at which the next start is tried.
        undecided: How many frames the last start had that could not be told from another; 0 if there was none.
        leaning: ``(3,)`` how the object turns in that start, as a rotation vector; None if there was none.
        waits_for: Why the start waits, where that is not lack of motion.
        usual: What tracked frames have cost.
        lost_for: How many frames in a row the object has been lost; those without a mask, where nothing can be tried,
            count as one.
        doubted_for: How many frames in a row have been lost or hardly believed.
        tried: The best pose of the last frame, where that had a mask and was not believed.
        trail: Poses and indices of the last frames that were believed.
        colours: Of object and surroundings in frames that were believed.
        past: The last frames that were believed, for what moves along.
        anew: A second start, under way while the object is lost and there is a mask; see `anew`.
        aside: Other maps of the object.
        spans: First and last index of earlier frames that the present map answered; since: from which index it does.
        guessed: Whether how it lies to the first map is a guess.
        reversal_tried: How many keyframes there were, and how many degrees they had turned, when depth was last tried
            the other way round.
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

    def advanced(
        self, pose: Pose, index: int, grey: NDArray[np.uint8], followed: FollowedPoints
    ) -> SolverState:
        """One frame later."""
        return replace(
            self, last_pose=(pose, index), previous_pose=self.last_pose, grey=grey, tracked_points=followed
        )


ONLINE_CLASSES = (
    InactiveMap,
    SolverState,
    ColourModels,
    MotionReference,
    ObjectMap,
    Keyframe,
    Surface,
    FollowedPoints,
    Keypoints,
    LossBaseline,
)
"""What a `Belief` is made of beside `tracking3d.estimation.solver.STATE_CLASSES`."""
