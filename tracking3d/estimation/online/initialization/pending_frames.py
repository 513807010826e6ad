"""Initialization: points are tracked and matched through the first frames until a map can be estimated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.features.klt import (
    MOST_POINTS,
    PLAIN,
    FollowedPoints,
    new_corners,
    texture_strength,
)
from tracking3d.estimation.online.features.sift import SIFT, Detector, detect, match
from tracking3d.estimation.online.initialization.initial_map import (
    InitialMap,
    initialize_without_points,
    solve_start,
    with_contrast,
)
from tracking3d.estimation.online.initialization.structure_from_motion import image_deformation
from tracking3d.estimation.online.mapping.focal_length import lens_hypotheses
from tracking3d.estimation.online.mapping.local_mapping import tracks_of
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import MOST_WAITING, Initializing, thin_out

MOTION = 0.03
"""Image deformation at which an initialization is first tried, see `image_deformation`."""
_MOTION_AFTER_REST = 0.06
"""The same for an object that rested until then. A hand that takes hold of a thing nudges it by a few degrees, which
tell little of its shape, and covers some of it."""
_RETRY_FACTOR = 1.3  # factor by which the deformation must grow before the next attempt
_MAX_BUNDLE_COST = 0.5  # bundle cost above which the points are not reliable: residuals of 0.8 pixels
_MIN_FRAMES = 4  # fewest frames of an initialization
_MIN_FRAMES_WITHOUT_POINTS = 13
_MAX_DEFORMATION = 0.15  # deformation that no initial map explains though it allows for half a turn
_RETRY_INTERVAL = 5  # frames between attempts without points
# Share of the first frame's points that must be tracked to the last if they are reliable
_MIN_TRACKED_SHARE = 0.4
_MIN_SHARED = 0.1  # share of the first frame's points below which further frames add nothing
_MIN_POINT_SHARE = 0.6  # share of `MOST_POINTS`, below which new corners are detected
_SAME_PLACE = 1.5  # pixels
_MATCHED_FRAMES = 3  # earlier frames that each frame is matched with
_MAX_MASK_GAP = 3  # frames; a mask tracker may miss the object for so long
_NOISE_FACTOR = 1.3  # times the change between neighbouring frames, below which a change is noise
_LONG_STILL = 6  # frames without a change, from which they are left out of a start without points
_MIN_OUTLINE_CHANGE, _MIN_SHADING_CHANGE = 0.05, 0.004  # see `ImageChange`; the least that is no noise
# Log ratio of two costs, times the deformation, from which the better hypothesis is accepted; and the same if it is
# the better one for the second time.
_MIN_LEAD, _MIN_LEAD_AGAIN = 0.04, 0.02
_DECISIVE_MOTION = 0.3  # deformation from which more motion decides nothing
_WELL_TRACKED = 0.25  # bundle cost of points that are tracked well
_MIN_OVERLAP = 0.7  # IoU with the masks, below which a map without points is not accepted (chosen)
_SAME_AXIS = 0.87  # cosine of 30 degrees
_TWO_WAYS = "the first frames can be explained in two ways, as when near and far are exchanged, until it turns further"
_NOT_MOVED = "the object has not moved yet"
_NO_SHAPE = "no shape that was tried so far covers the masks of the frames"
_STILL = "nothing shows that the object turns: it is still, or turns about an axis of its symmetry"


def add_pending_frame(
    object_map: ObjectMap,
    earlier: tuple[Keyframe, ...],
    view: Keyframe,
    image: NDArray[np.uint8],
    detector: Detector = SIFT,
) -> tuple[ObjectMap, Keyframe]:
    """A view into which points are tracked or matched; their depth is not known yet."""
    if _is_gone((*earlier, view)):
        return object_map, replace(view, points=FollowedPoints.none())
    if (inside := view.mask) is not None:
        view = replace(view, strength=texture_strength(image, inside))
    if inside is None or len(view.points) >= _MIN_POINT_SHARE * MOST_POINTS:
        return object_map, view
    keypoints = detect(image, inside, detector=detector)
    label = np.full(len(keypoints), -1, np.int64)
    if len(view.points) and len(keypoints):
        gap = np.linalg.norm(keypoints.pixel[:, None] - view.points.pixel[None], axis=2)
        label = np.where(gap.min(1) < _SAME_PLACE, view.points.landmark[gap.argmin(1)], -1)
    taken = set(view.points.landmark.tolist())
    for other in earlier[::-1][:_MATCHED_FRAMES]:
        for here, there in match(keypoints, other.keypoints):
            name = int(other.keypoint_landmark[there])
            if label[here] < 0 <= name and name not in taken:
                label[here] = name
                taken.add(name)
    corners = new_corners(
        image,
        inside,
        np.concatenate([view.points.pixel, keypoints.pixel]),
        MOST_POINTS - len(view.points) - len(keypoints),
    )
    fresh = label < 0
    base = len(object_map.landmarks)
    label[fresh] = base + np.arange(fresh.sum())
    corner_names = base + fresh.sum() + np.arange(len(corners))
    own, first = np.unique(label, return_index=True)
    again = ~np.isin(own, view.points.landmark)
    points = FollowedPoints(
        np.concatenate([view.points.landmark, own[again], corner_names]).astype(np.int64),
        np.concatenate([view.points.pixel, keypoints.pixel[first][again], corners]),
    )
    added = int(fresh.sum()) + len(corners)
    object_map = replace(
        object_map,
        landmarks=np.concatenate([object_map.landmarks, np.full((added, 3), np.nan)]),
        candidate=np.concatenate([object_map.candidate, np.zeros(added, bool)]),
    )
    return object_map, replace(view, points=points, keypoints=keypoints, keypoint_landmark=label)


def try_initialize(
    state: Initializing, config: OnlineConfig, ended: bool = False
) -> tuple[Initializing, InitialMap | None]:
    """The initial map if the pending frames determine it; else None, and the motion of the next attempt.

    Args:
        state: The state with the pending frames.
        config: The solver's options.
        ended: Whether no more frames follow, so that these must suffice.
    """
    waiting = state.pending
    views = [view for view, _ in waiting if view.mask is not None]
    if len(views) < _MIN_FRAMES:
        return state, None
    ended = ended or _is_gone([view for view, _ in waiting])  # the frames until then must suffice
    if np.median([view.strength for view in views]) < PLAIN:
        enough = (
            len(views) >= _MIN_FRAMES_WITHOUT_POINTS
            and (len(views) - _MIN_FRAMES_WITHOUT_POINTS) % _RETRY_INTERVAL == 0
        )
        if not enough and not ended:
            return state, None
        return _start_of_plain_object(state, views, config, ended)
    names = np.unique(np.concatenate([view.points.landmark for view in views]))
    motion = image_deformation(tracks_of(views, names[~state.object_map.candidate[names]]))
    still_there = np.isin(views[0].points.landmark, views[-1].points.landmark)
    shared = float(still_there.mean()) if len(still_there) else 0.0
    least = _MOTION_AFTER_REST if state.object_map.started_at_rest else MOTION
    # A textured object whose points keep their arrangement has not turned, however much covers it or moves with it.
    if motion < least and not ended and (shared <= _MIN_SHARED or len(views) >= MOST_WAITING):
        state = replace(state, waiting_reason=_NOT_MOVED, ambiguous_frames=0)
        if shared <= _MIN_SHARED:
            return replace(state, pending=_recent_frames(waiting)), None
        at_rest = replace(state.object_map, started_at_rest=True)
        return replace(state, object_map=at_rest, pending=_subsample(waiting)), None
    waited = ended or len(views) >= MOST_WAITING
    # Points that fail do not gain from more motion: pixels and outlines are used instead.
    wild = motion > _MAX_DEFORMATION and len(views) >= _MIN_FRAMES_WITHOUT_POINTS
    due = max(state.next_attempt, least)
    if (
        motion < due
        and not waited
        and shared > _MIN_SHARED
        and not (wild and len(views) % _RETRY_INTERVAL == 0)
    ):
        return state, None
    state = replace(state, next_attempt=motion * _RETRY_FACTOR)
    may_wait = not waited and shared > _MIN_SHARED and motion < _DECISIVE_MOTION
    # Without motion any shape explains the points.
    starts = _starts_from_points(state, views, config) if motion >= MOTION else []
    if may_wait and _is_undecided(starts, motion, state.ambiguous_rotation):
        return replace(
            state, waiting_reason=_TWO_WAYS, ambiguous_frames=len(views), ambiguous_rotation=_turn(starts[0])
        ), None
    if state.ambiguous_frames and starts and starts[0].bundle > _WELL_TRACKED:
        starts = _starts_from_points(state, views[: state.ambiguous_frames], config)
    if not starts or starts[0].bundle > _MAX_BUNDLE_COST:
        if (
            not waited
            and not wild
            and (shared > _MIN_TRACKED_SHARE or len(views) < _MIN_FRAMES_WITHOUT_POINTS)
        ):
            return state, None
        state, turning = _start_without_points(state, views, config)
        if turning is None:
            return state, None
        if turning.overlap < _MIN_OVERLAP and not starts:
            return _refuse(state, views), None
        starts = sorted([*starts, turning], key=lambda start: (start.overlap < _MIN_OVERLAP, start.cost))
    return state, starts[0] if starts else None


def why_no_map(state: Initializing) -> str:
    """What was found where the pending frames do not determine a map, though no more follow."""
    views = [view for view, _ in state.pending if view.mask is not None]
    if len(views) < _MIN_FRAMES:
        return f"a first map takes {_MIN_FRAMES} frames that show the object, and there are {len(views)}"
    kept = [
        float(np.isin(a.points.landmark, b.points.landmark).mean())
        for a, b in pairwise(views)
        if len(a.points)
    ]
    again = float(np.median(kept)) if kept else 0.0
    if np.median([view.strength for view in views]) >= PLAIN and again <= _MIN_SHARED:
        return (
            f"the views are too far apart: {100 * again:.0f} % of the points of one are found again in the next; take "
            "more in between"
        )
    return state.waiting_reason or _STILL


def _starts_from_points(state: Initializing, views: list[Keyframe], config: OnlineConfig) -> list[InitialMap]:
    weights = FitWeights(smoothness=config.smoothness)
    return solve_start(state.object_map, lens_hypotheses(state.camera), views, weights, config.surface_prior)


def _start_of_plain_object(
    state: Initializing, views: list[Keyframe], config: OnlineConfig, ended: bool
) -> tuple[Initializing, InitialMap | None]:
    """The initial map of an object without texture, from the frames since it began to turn."""
    last_still = _last_still_view(views)
    if last_still is not None and last_still >= _LONG_STILL:
        views = views[last_still:]
        if len(views) < _MIN_FRAMES_WITHOUT_POINTS and not ended:
            return replace(_set_aside(state, views[0].index), waiting_reason="", ambiguous_frames=0), None
    state, start = _start_without_points(state, views, config)
    if start is not None and start.overlap < _MIN_OVERLAP:
        return _refuse(state, views), None
    return state, start


def _start_without_points(
    state: Initializing, views: list[Keyframe], config: OnlineConfig
) -> tuple[Initializing, InitialMap | None]:
    """The initial map from pixels and outlines alone; None if nothing shows that the object rotates."""
    waiting = state.pending
    if _last_still_view(views) is None:
        kept = _subsample(waiting) if len(views) >= MOST_WAITING else waiting
        return replace(state, pending=kept, waiting_reason=_STILL, ambiguous_frames=0), None
    if state.needs_points:  # given up: its frames have none that last
        return replace(state, pending=()), None
    if state.feature_space is not None:
        views = [with_contrast(view, state.feature_space.with_contrast()) for view in views]
    return state, initialize_without_points(
        state.object_map, state.camera, views, FitWeights(smoothness=config.smoothness)
    )[0]


def _refuse(state: Initializing, views: list[Keyframe]) -> Initializing:
    """The state after a map without points that misses its masks: later frames may show more of the shape."""
    later = views[min(_RETRY_INTERVAL, len(views) - 1)].index
    return replace(_set_aside(state, later), waiting_reason=_NO_SHAPE, ambiguous_frames=0)


def _set_aside(state: Initializing, first: int) -> Initializing:
    """The state whose first map is made without the pending frames before the one of index ``first``."""
    waiting = state.pending
    rested = thin_out((*state.rested, *(one for one in waiting if one[0].index < first)))
    return replace(state, rested=rested, pending=tuple(one for one in waiting if one[0].index >= first))


def _is_undecided(starts: list[InitialMap], motion: float, leaning: NDArray[np.float64] | None) -> bool:
    """Whether another initial map with a different rotation costs hardly more than the best, given so little motion.

    More motion helps only if the points are tracked well.

    Args:
        starts: Initial maps by rising cost.
        motion: See `image_deformation`.
        leaning: The rotation of the best initial map in the last attempt; if it wins again, a smaller margin suffices.
    """
    if len(starts) < 2 or starts[0].bundle > _WELL_TRACKED:
        return False
    best = _turn(starts[0])
    rivals = [start for start in starts[1:] if not _same_axis(best, _turn(start))]
    if not rivals:
        return False
    lead = motion * math.log(rivals[0].cost / max(starts[0].cost, 1e-9))
    again = leaning is not None and _same_axis(best, leaning)
    return lead < (_MIN_LEAD_AGAIN if again else _MIN_LEAD)


def _turn(start: InitialMap) -> NDArray[np.float64]:
    """``(3,)`` rotation vector from the first view of an initial map to the last, in camera coordinates."""
    first, *_, last = start.object_map.keyframes
    return Rotation.from_matrix((last.pose.R @ first.pose.R.T).cpu().numpy()).as_rotvec()


def _same_axis(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two rotations have the same axis; their angles depend on focal length and relief."""
    return bool(a @ b >= _SAME_AXIS * np.linalg.norm(a) * np.linalg.norm(b))


def _is_gone(views: Sequence[Keyframe]) -> bool:
    """Whether the object has been out of sight for longer than a mask tracker's brief failure."""
    return len(views) > _MAX_MASK_GAP and all(view.mask is None for view in views[-_MAX_MASK_GAP:])


def _last_still_view(views: list[Keyframe]) -> int | None:
    """The place of the last view in which the object looks as in the first one; None if it still does in the last.

    Apart from a similarity of the image, which is the camera's motion in a hand.
    """
    near = [image_change(a.observation, b.observation) for a, b in pairwise(views)]
    outline = max(_MIN_OUTLINE_CHANGE, _NOISE_FACTOR * float(np.median([one.outline for one in near])))
    shading = _MIN_SHADING_CHANGE + _NOISE_FACTOR * float(np.median([one.shading for one in near]))

    def has_changed(view: Keyframe) -> bool:
        change = image_change(views[0].observation, view.observation)
        return change.outline > outline or change.shading > shading

    if not has_changed(views[-1]):
        return None
    places = range(len(views) - 2, 0, -1)
    return next((place for place in places if not has_changed(views[place])), 0)


def _recent_frames(
    waiting: tuple[tuple[Keyframe, FrameEstimate], ...],
) -> tuple[tuple[Keyframe, FrameEstimate], ...]:
    """The last pending frames, from the first on that shares enough points with the last."""
    newest = waiting[-1][0].points.landmark
    for place, (view, _) in enumerate(waiting):
        there = np.isin(view.points.landmark, newest)
        if view.mask is not None and len(there) and there.mean() > _MIN_TRACKED_SHARE:
            return waiting[place:]
    return waiting[-1:]


def _subsample(
    waiting: tuple[tuple[Keyframe, FrameEstimate], ...],
) -> tuple[tuple[Keyframe, FrameEstimate], ...]:
    """Every second pending frame, with the first and the last."""
    return (*waiting[:-1:2], waiting[-1])


# How the image of an object has changed between two frames, apart from what a shaking camera does to it.
#
# A camera in a hand moves the image of a still object, turns it about the line of sight and changes its size. Whatever
# is left after this similarity is taken away shows that the object turns, or that something covers it.

_BLUR = 0.016  # standard deviation, relative to the crop's side, with which masks are aligned
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-4)
_INSIDE = 0.9  # value of a mask from which a pixel is compared
_MARGIN = 5  # pixels from the outline at which pixels are compared

Image = NDArray[np.float32]


@dataclass(frozen=True)
class ImageChange:
    """A change between two frames."""

    outline: float  # 1 - IoU of the aligned masks
    shading: float  # mean absolute difference of the aligned grey images inside both masks, in [0, 1]


def image_change(first: Observation, second: Observation) -> ImageChange:
    """The change from one observation of an object to another, both with a mask, as the masks' similarity leaves it.

    What covers the object in either of them is left out: a thumb that moves is no turn.
    """
    mask_a, mask_b = (
        np.ascontiguousarray(one.completed_mask.cpu().numpy(), np.float32) for one in (first, second)
    )
    if not mask_a.any() or not mask_b.any():
        return ImageChange(0.0, 0.0)
    grey_a, grey_b = (_grey(one) for one in (first, second))
    similarity = _similarity(mask_a, mask_b)

    def warped(image: Image) -> Image:
        size = (mask_a.shape[1], mask_a.shape[0])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, similarity, size, flags=flags), np.float32)

    mask_b, grey_b = warped(mask_b), warped(grey_b)
    covered_a, covered_b = (
        np.zeros(mask_a.shape, np.float32) if one.occluder is None else one.occluder.cpu().numpy()
        for one in (first, second)
    )
    hidden = (covered_a > 0.5) | (warped(np.ascontiguousarray(covered_b)) > 0.5)
    mask_a, mask_b = (np.where(hidden, np.float32(0), mask) for mask in (mask_a, mask_b))
    outline = 1 - float(np.minimum(mask_a, mask_b).sum() / max(np.maximum(mask_a, mask_b).sum(), 1e-6))
    both = ((mask_a > _INSIDE) & (mask_b > _INSIDE)).astype(np.uint8)
    inside = cv2.erode(both, np.ones((_MARGIN, _MARGIN), np.uint8)) > 0
    shading = float(np.abs(grey_a - grey_b)[inside].mean()) if inside.any() else 0.0
    return ImageChange(outline, shading)


def _grey(observation: Observation) -> Image:
    side = observation.mask.shape[-1]
    grey = np.ascontiguousarray(observation.image.mean(0).cpu().numpy(), np.float32)
    return np.asarray(cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _similarity(first: Image, second: Image) -> NDArray[np.float32]:
    """``(2, 3)`` from pixels of one mask to the other's: sizes and centres agree, then it is turned to overlap best."""
    (x_a, y_a), (x_b, y_b) = (_centre(mask) for mask in (first, second))
    scale = float(np.sqrt(second.sum() / first.sum()))
    placed = np.array([[scale, 0, x_b - scale * x_a], [0, scale, y_b - scale * y_a], [0, 0, 1]])
    blur = _BLUR * first.shape[0]
    a, b = (cv2.GaussianBlur(mask, (0, 0), blur) for mask in (first, second))
    size = (first.shape[1], first.shape[0])
    b = cv2.warpAffine(b, placed[:2], size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    turn = np.eye(3)
    try:
        _, found = cv2.findTransformECC(a, b, np.eye(2, 3, dtype=np.float32), cv2.MOTION_EUCLIDEAN, _STOP)
        turn[:2] = found
    except cv2.error:  # the masks have nothing in common that could be turned
        pass
    return np.asarray((placed @ turn)[:2], np.float32)


def _centre(mask: Image) -> tuple[float, float]:
    moments = cv2.moments(mask)
    return moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
