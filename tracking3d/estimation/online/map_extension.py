"""The largest map extended over the frames that it does not explain, from the frames on both sides of them.

A video often begins where the object shows little, or a slip ends one map and begins another. Once the video has ended,
an object that is known well in some frames can be tracked from these into the others, backwards as well as forwards.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import OnlineConfig, PipelineConfig
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.atlas.atlas import activate_largest_map, frames_of_map
from tracking3d.estimation.online.features.klt import FollowedPoints, grey
from tracking3d.estimation.online.frame_mapping import FrameMapping
from tracking3d.estimation.online.mapping.focal_length import inactive_map_through_lens
from tracking3d.estimation.online.mapping.global_refinement import refine_globally
from tracking3d.estimation.online.mapping.keyframe_insertion import prune_landmarks
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import InactiveMap, SolverPhase, SolverState
from tracking3d.estimation.solver import Gap, ModelCoverage
from tracking3d.frames import TRACKED_CONFIDENCE

_ROOM = 1.5
"""Factor by which an extended map may have more keyframes."""
_NEVER_REVERSED = (1 << 30, 360.0)
"""A `SolverState.reversal_attempt` after which there is no other: poses of other frames refer to the map as it is."""


@dataclass(frozen=True)
class MapExtension(FrameMapping):
    """What the solver `online` needs for `tracking3d.estimation.solver.ExtendingSolver`."""

    def begin_extension(
        self, state: SolverState, confidence: Mapping[int, float]
    ) -> tuple[SolverState, ModelCoverage] | None:
        """The state with the largest map active, and what it explains; None if it cannot be extended.

        Keyframes that neither an estimate nor enough landmarks support are removed; the others are refined together,
        and the focal length with them, if it is not given: it may be why the others are not explained.
        """
        if state.phase is SolverPhase.INITIALIZING:
            return None
        last = state.last_pose[1]
        spans = (*state.spans, (state.active_since, last))
        state = activate_largest_map(replace(state, spans=spans, active_since=last + 1))
        object_map = state.object_map
        if object_map.pointless or object_map.fixed_keyframes:
            return None
        own = {index: confidence[index] for index in frames_of_map(state, confidence)}
        explained = frozenset(index for index, known in own.items() if known >= TRACKED_CONFIDENCE)
        object_map = _remove_unsupported(object_map, explained)
        object_map, camera = refine_globally(object_map, state.camera, self.online)
        anchors = explained.intersection(view.index for view in object_map.keyframes)
        state = replace(
            state,
            camera=camera,
            object_map=object_map,
            surface=object_map.surface(),
            reinitialization=None,
            inactive_maps=tuple(
                inactive_map_through_lens(other, state.camera, camera) for other in state.inactive_maps
            ),
        )
        return state, ModelCoverage(own, anchors)

    def extend(self, state: SolverState, gap: Gap) -> tuple[SolverState, list[FrameEstimate]]:
        """Track the object through a gap, and insert keyframes there; no estimates if its keyframe was culled."""
        if all(view.index != gap.anchor.index for view in state.object_map.keyframes):
            return state, []
        aside = state.inactive_maps
        number = max(state.last_pose[1], *(view.index for view in state.object_map.keyframes)) + 1
        state, estimates = _enter(state, gap, number), list[FrameEstimate]()
        roomier = replace(self, config=_with_more_keyframes(self.config))
        for frame, mask in gap.frames:
            shown = replace(frame, index=number + abs(frame.index - gap.anchor.index))
            state, estimate = roomier._track(state, shown, grey(frame.image), mask.found)
            estimates.append(replace(estimate, index=frame.index))
        return replace(_leave(state, gap, number), inactive_maps=aside), estimates

    def end_extension(self, state: SolverState, found: Collection[int], last: int) -> SolverState:
        """The state for ``refine``; maps of frames that the largest one explains now are given up."""
        kept = tuple(other for other in state.inactive_maps if not _is_explained(other, found))
        given_up = [other for other in state.inactive_maps if _is_explained(other, found)]
        return replace(
            state,
            inactive_maps=kept,
            spans=(*state.spans, *(span for other in given_up for span in other.spans)),
            last_pose=(state.last_pose[0], last),
            previous_pose=None,
            reversal_attempt=(0, 0.0),
        )

    def start_from(self, state: SolverState, poses: Mapping[int, NDArray[np.float64]]) -> SolverState:
        """The state that refines frames from other poses than the causal ones."""
        return replace(state, extended=dict(poses))


def _with_more_keyframes(config: PipelineConfig) -> PipelineConfig:
    """The configuration for a map to which the sides are added that were not explained."""
    assert isinstance(config.solver, OnlineConfig)
    most = int(_ROOM * config.solver.max_keyframes)
    return config.model_copy(update={"solver": config.solver.model_copy(update={"max_keyframes": most})})


def _remove_unsupported(object_map: ObjectMap, explained: frozenset[int]) -> ObjectMap:
    """The map without keyframes that are guesses, unless half of them are."""
    sound = tuple(
        view
        for place, view in enumerate(object_map.keyframes)
        if place == 0 or view.index in explained or _inliers(object_map, view) >= ENOUGH_POINTS
    )
    if 2 * len(sound) < len(object_map.keyframes) or len(sound) < 2:
        return object_map
    return prune_landmarks(replace(object_map, keyframes=sound), FollowedPoints.none())[0]


def _inliers(object_map: ObjectMap, view: Keyframe) -> int:
    """How many landmarks a keyframe shares with others."""
    return int((object_map.sightings[view.points.landmark] >= 2).sum())


def _enter(state: SolverState, gap: Gap, number: int) -> SolverState:
    """The state after a gap's anchor, which is numbered ``number``; the nearest keyframes are the latest ones."""
    anchor = gap.anchor.index
    own = next(view for view in state.object_map.keyframes if view.index == anchor)

    def nearness(view: Keyframe) -> tuple[bool, int]:
        beyond = view.index < anchor if gap.backwards else view.index > anchor
        return not beyond, -abs(view.index - anchor)

    keyframes = tuple(sorted(state.object_map.keyframes, key=nearness))
    object_map = replace(state.object_map, keyframes=keyframes)
    return replace(
        state,
        object_map=object_map,
        last_pose=(own.pose, number),
        previous_pose=None,
        grey=grey(gap.anchor.image),
        tracked_points=own.points,
        lost_frames=0,
        doubtful_frames=0,
        last_candidate=None,
        trajectory=((own.pose, number),),
        motion_references=(),
        inactive_maps=(),
        reversal_attempt=_NEVER_REVERSED,
    )


def _leave(state: SolverState, gap: Gap, number: int) -> SolverState:
    """The state after a gap: keyframes have their frames' own indices, and come in order of time."""
    sign = -1 if gap.backwards else 1
    found = {}
    for view in state.object_map.keyframes:  # the later one of a frame takes the place of the earlier one
        index = view.index
        if index >= number:
            index = gap.anchor.index + sign * (index - number)
        found[index] = replace(view, observation=replace(view.observation, index=index))
    keyframes = tuple(found[index] for index in sorted(found))
    object_map = replace(state.object_map, keyframes=keyframes, asked_landmarks=-1)
    object_map = prune_landmarks(object_map, FollowedPoints.none())[0]
    return replace(
        state,
        object_map=object_map,
        surface=object_map.surface(),
        trajectory=(),
        tracked_points=FollowedPoints.none(),
    )


def _is_explained(other: InactiveMap, found: Collection[int]) -> bool:
    """Whether the object was found, with the largest map, in at least half of the frames of another map."""
    frames = sum(last - first + 1 for first, last in other.spans)
    inside = sum(any(first <= index <= last for first, last in other.spans) for index in found)
    return 2 * inside >= frames
