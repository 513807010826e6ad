"""What moves as the object does, of what lies beside its mask: one frame against an earlier one, while frames come.

A side that turns into view is in no mask yet, and no surface says how deep it lies. But where one of its points was in
an earlier frame is known but for that depth, since the object's poses are. So every pixel is asked whether the earlier
frame shows the same patch at one of a few depths about that of the surface beside it, and whether the background's
motion explains it better. Where nothing has texture, or both motions lead to the same place, there is no answer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.segmentation.colour_models import relative_distance
from tracking3d.estimation.segmentation.motion_cue import background_motion, motion_parallax, smaller
from tracking3d.geometry.camera import Camera, Window
from tracking3d.scene.surface import draw_depth
from tracking3d.scene.view import Mask, Plane
from tracking3d.trackers.colour_models import histograms, log_ratio

_DEPTHS = np.linspace(-0.4, 1.2, 9)
"""Where a pixel beside the silhouette may lie, behind the surface beside it, in radii of the object: what turns into
view lies behind the edge that it turns about."""
_IN_FRONT = (-0.8, -1.2, -1.6)
"""The same of where none of it can be."""
_LARGEST = 144  # pixels of the window's side
_MOVED = 4.0
"""Pixels of a frame as `smaller` gives it by which the motions part in the median, at least."""
_APART = (1.0, 3.0)
"""Such pixels by which a pixel's own two ways part from which on, and in full, it can be told."""
_ATTEMPTS = 2  # to find an earlier frame in which they part by so much
_PATCH, _SHIFT = 7, 3  # pixels
PATCH = _PATCH / _LARGEST
"""Side of the patches that are compared, as a share of the window's side."""
_NOISE = 3.0  # grey levels
_MOST = 1.5
_TEXTURE = (8.0, 24.0)
"""Mean contrast of neighbouring pixels in a patch, grey levels, from which on, and in full, its motion can be told."""
_SQUARE = np.ones((3, 3), np.uint8)

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MotionReference:
    """A frame whose pose is trusted, as small as motion is looked for in it."""

    grey: NDArray[np.uint8]  # (h, w) from `tracking3d.estimation.segmentation.motion_cue.smaller`
    mask: Mask  # (h, w) where the object is
    T_cam_obj: Matrix  # (4, 4)
    size: tuple[int, int]  # (H, W) of the frame itself

    @classmethod
    def of(cls, grey: NDArray[np.uint8], mask: Mask, T_cam_obj: Matrix) -> Self:
        """Of a frame and its mask, both ``(H, W)``."""
        small = smaller(grey)
        seen = cv2.resize(mask.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST)
        return cls(small, seen > 0, T_cam_obj, grey.shape)

    @property
    def to_small(self) -> Matrix:
        """``(3, 3)`` from the frame's pixels to those of ``grey``; centres are at integers in both."""
        (height, width), (rows, columns) = self.size, self.grey.shape
        across, down = columns / width, rows / height
        return np.array([[across, 0.0, (across - 1) / 2], [0.0, down, (down - 1) / 2], [0.0, 0.0, 1.0]])


def online_motion_log_odds(
    here: MotionReference,
    earlier: Sequence[MotionReference],
    window: Window,
    camera: Camera,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> Plane | None:
    """``(S, S)`` in [-1, 1] whether a window's pixels move as the object does (positive), or as the background.

    Args:
        here: The frame; its mask is where the object is known to be.
        earlier: Frames before it, in order of time.
        window: Of the frame, ``S`` pixels wide.
        camera: The camera of all frames.
        vertices: ``(V, 3)`` of the object.
        faces: ``(F, 3)``.

    Returns:
        None if no earlier frame can tell.
    """
    seen = Window(window.left, window.top, window.side, min(window.size, _LARGEST))
    inverse_depth, beyond = draw_depth(seen.K(camera), here.T_cam_obj, vertices, faces, seen.shape)
    drawn = beyond == 0
    if not earlier or not drawn.any():
        return None
    ways = _ways_apart(here, earlier, seen, camera, drawn, inverse_depth)
    if ways is None:
        return None
    radius = float(np.linalg.norm(vertices - vertices.mean(0), axis=1).max())
    told = _cue_from_flows(here, seen, ways, inverse_depth, radius)
    return cv2.resize(told, (window.size, window.size), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True, eq=False)
class _Ways:
    """How a window's pixels get into the ``grey`` of an earlier frame."""

    past: MotionReference  # the earlier frame
    of_surface: Matrix  # (3, 4) from u, v, 1, 1 / depth by the object's motion
    of_background: Matrix  # (3, 3) from u, v, 1 by the background's

    @classmethod
    def of(
        cls, here: MotionReference, past: MotionReference, window: Window, camera: Camera, background: Matrix
    ) -> Self:
        """With the background's homography ``(3, 3)`` from the frame's ``grey`` to the earlier one's."""
        T = past.T_cam_obj @ np.linalg.inv(here.T_cam_obj)
        K = past.to_small @ camera.K
        of_surface = np.column_stack([K @ T[:3, :3] @ np.linalg.inv(window.K(camera)), K @ T[:3, 3]])
        return cls(past, of_surface, background @ here.to_small @ window.to_frame)

    def at(self, inverse_depth: Plane) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See `tracking3d.estimation.segmentation.motion_cue.motion_parallax`."""
        return motion_parallax(
            inverse_depth, self.of_surface, self.of_background, self.past.grey.shape, _APART
        )

    def apart(self, drawn: Mask, inverse_depth: Plane) -> float:
        """Median of the pixels by which both part on the surface; 0 if they lead out of the frame."""
        ways, _ = self.at(inverse_depth)
        across, down = np.moveaxis(ways[0] - ways[1], -1, 0)[:, drawn & (ways[0, ..., 0] > 0)]
        return float(np.median(np.hypot(across, down))) if across.size else 0.0


def _ways_apart(
    here: MotionReference,
    earlier: Sequence[MotionReference],
    window: Window,
    camera: Camera,
    drawn: Mask,
    inverse_depth: Plane,
) -> _Ways | None:
    """Into the latest earlier frame in which the two motions part by enough; None if they do in none.

    As if the background stood still it is guessed which that is, and once more when its motion is known.
    """
    most = len(earlier)
    lag = most
    for guess in range(1, most + 1):
        if _Ways.of(here, earlier[-guess], window, camera, np.eye(3)).apart(drawn, inverse_depth) >= _MOVED:
            lag = guess
            break
    for _ in range(_ATTEMPTS):
        past = earlier[-lag]
        background = background_motion(here.grey, past.grey, here.mask)
        if background is None:
            return None
        ways = _Ways.of(here, past, window, camera, background)
        parted = ways.apart(drawn, inverse_depth)
        if parted >= _MOVED:
            return ways
        wanted = int(np.ceil(lag * _MOVED / max(parted, 1e-3)))
        if lag == most or wanted > 2 * most:
            return None
        lag = min(max(wanted, lag + 1), most)
    return None


def _cue_from_flows(
    here: MotionReference, window: Window, ways: _Ways, inverse_depth: Plane, radius: float
) -> Plane:
    """``(S, S)`` see `online_motion_log_odds`."""
    grey, past = _warp_to_window(here.grey, here.to_small @ window.to_frame, window), ways.past
    ours = np.full(grey.shape, np.inf, np.float32)
    told = np.zeros(grey.shape, np.float32)
    depth = np.asarray(1 / inverse_depth, np.float32)
    (near, background), _ = ways.at(inverse_depth)
    for offset in radius * _DEPTHS:
        way, share = _at(ways, depth, offset)
        cost = _residual(grey, past.grey, way)
        better = (cost < ours) & (share > 0)
        ours, told = np.where(better, cost, ours), np.where(better, share, told)
    theirs = _residual(grey, past.grey, background)
    # What was behind the object looks like nothing that was seen before, unless it is a side that turns into view:
    # that is no wider than the object has turned, and its patches do not fit where it cannot have been.
    covered = cv2.remap(past.mask.astype(np.uint8), background, None, cv2.INTER_NEAREST) > 0
    new = covered & _has_turned_into_view(here, window, near, way)
    if new.any():
        wrong = [_residual(grey, past.grey, _at(ways, depth, radius * offset)[0]) for offset in _IN_FRONT]
        theirs = np.where(new, np.minimum(theirs, np.min([_distinct(grey), *wrong], 0)), theirs)
    known = np.isfinite(ours) & (~covered | new)
    cue = np.log((theirs + _NOISE) / (np.where(known, ours, 0) + _NOISE))
    cue = np.clip(cue / _MOST, -1, 1)
    cue = np.where(covered, np.maximum(cue, 0), cue)
    return np.asarray(cue * told * known * _texture(grey), np.float32)


def _at(ways: _Ways, depth: Plane, offset: float) -> tuple[NDArray[np.float32], Plane]:
    """Where pixels were by the object's motion, and how far that can be told, if they lie ``offset`` deeper."""
    deeper = depth + np.float32(offset)
    way, share = ways.at(np.where(deeper > 0, 1 / deeper, 0).astype(np.float32))
    return way[0], share


def _has_turned_into_view(
    here: MotionReference, window: Window, near: NDArray[np.float32], far: NDArray[np.float32]
) -> Mask:
    """``(S, S)`` what is known of the object, and what may be a side that was behind its edge in the earlier frame.

    Args:
        here: The frame.
        window: Of it.
        near: ``(S, S, 2)`` where pixels were in the earlier frame as parts of the surface beside them.
        far: The same as parts of what lies deepest behind it.
    """
    known = _warp_to_window(here.mask.astype(np.uint8), here.to_small @ window.to_frame, window)
    if known.all() or not known.any():
        return known > 0
    distance = cv2.distanceTransform(1 - known, cv2.DIST_L2, cv2.DIST_MASK_5)
    smooth = cv2.GaussianBlur(distance, (0, 0), 2.0)
    outward = [cv2.Sobel(smooth, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1))]
    # What lies behind an edge has come out from behind it by as much as it moved past the edge.
    within = (near[..., 0] > 0) & (far[..., 0] > 0)
    come = ((near - far)[..., 0] * outward[0] + (near - far)[..., 1] * outward[1]) * within
    return np.asarray((known > 0) | (distance * (here.to_small[0, 0] / window.scale) < come))


def _residual(
    grey: NDArray[np.uint8], there: NDArray[np.uint8], way: NDArray[np.float32]
) -> NDArray[np.float32]:
    """``(S, S)`` grey levels by which patches differ; a value between those of a pixel's neighbours does not."""
    seen = cv2.remap(there, way, None, cv2.INTER_LINEAR)
    above, below = cv2.subtract(grey, cv2.dilate(seen, _SQUARE)), cv2.subtract(cv2.erode(seen, _SQUARE), grey)
    return cv2.blur(cv2.add(above, below).astype(np.float32), (_PATCH, _PATCH))


def _distinct(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """``(S, S)`` grey levels by which a patch differs, at least, from those a few pixels beside it (Moravec)."""
    wide = cv2.copyMakeBorder(grey, *(_SHIFT,) * 4, cv2.BORDER_REPLICATE)
    size = len(grey)
    least = np.full(grey.shape, np.inf, np.float32)
    for right, down in ((1, 0), (0, 1), (1, 1), (1, -1)):
        row, column = _SHIFT * (1 + down), _SHIFT * (1 + right)
        moved = wide[row : row + size, column : column + size]
        least = np.minimum(least, cv2.blur(cv2.absdiff(grey, moved).astype(np.float32), (_PATCH, _PATCH)))
    return least


def _texture(grey: NDArray[np.uint8]) -> Plane:
    """``(S, S)`` in [0, 1]: what is even moves with anything."""
    contrast = cv2.subtract(cv2.dilate(grey, _SQUARE), cv2.erode(grey, _SQUARE)).astype(np.float32)
    around = cv2.blur(contrast, (_PATCH, _PATCH))
    return np.asarray(np.clip((around - _TEXTURE[0]) / (_TEXTURE[1] - _TEXTURE[0]), 0, 1), np.float32)


def _warp_to_window(image: NDArray[np.uint8], of_window: Matrix, window: Window) -> NDArray[np.uint8]:
    """``(S, S)`` an image at the pixels to which ``of_window`` ``(3, 3)`` takes a window's."""
    return cv2.warpAffine(
        image,
        of_window[:2],
        (window.size, window.size),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )


# Sides that turn into view: what moves with the object and lies against it becomes part of it.
#
# Motion shows where there are edges, and goes over the object's own outline by up to half a patch; so gaps are closed
# and the outermost is taken off again. An arm that holds the object moves along as well, but goes on beyond it: what
# has a colour of the background, too, is left out.

MOVES = 0.35
"""Of what `tracking3d.estimation.segmentation.online_motion_cue` says, from which on something does."""
_DISPUTED, _TAKEN = 2.0, 3.0  # log-odds: of motion where the masks differ, and of what is taken in
_CLOSED = 0.1  # of the root of the area: gaps between what moves along, which is seen where there are edges
_DENSE = 0.2  # share of a part in which motion is seen
_SURROUNDINGS = -1.0  # of `unlike_surroundings`, below which a colour is of them
_REACH = 0.15  # of the root of the area, in one frame
_FAR = 0.25  # of the root of the area, from which on something is background
_RARE = 0.002  # share of the surroundings that a colour needs to be theirs


def grow_region(
    log_odds: NDArray[np.float32],
    initial: NDArray[np.bool_],
    rendered: NDArray[np.bool_],
    moving: NDArray[np.float32],
    strange: NDArray[np.float32],
) -> NDArray[np.float32]:
    """``(S, S)`` log-odds with what motion says: where both masks differ, and of parts beside both that move along.

    Args:
        log_odds: ``(S, S)`` so far.
        initial: ``(S, S)`` the mask tracker's mask.
        rendered: ``(S, S)`` the silhouette.
        moving: ``(S, S)`` from `tracking3d.estimation.segmentation.online_motion_cue`.
        strange: ``(S, S)`` from `unlike_surroundings`.
    """
    known = initial | rendered
    log_odds = log_odds + np.where(initial ^ rendered, _DISPUTED * moving, 0)
    root = math.sqrt(max(int(np.count_nonzero(known)), 1))
    seen = (moving > MOVES) & (strange > _SURROUNDINGS) & ~known
    closed = cv2.morphologyEx((seen | known).astype(np.uint8), cv2.MORPH_CLOSE, _disc(_CLOSED * root))
    # A patch that reaches over the outline moves along with what it has of the object.
    closed = cv2.erode(closed, _disc(PATCH * len(known) / 4)) > 0
    added = closed & ~known & (moving > -MOVES) & (strange > _SURROUNDINGS)
    added = _touching(_visible_parts(added, seen), known) & (relative_distance(known) > -_REACH)
    return np.where(added, np.maximum(log_odds, _TAKEN), log_odds).astype(np.float32)


def motion_supported_share(
    mask: NDArray[np.bool_], initial: NDArray[np.bool_], moving: NDArray[np.float32]
) -> float:
    """Share of a mask ``(S, S)`` by which it differs from the initial one where motion says so."""
    more = _visible_parts(mask & ~initial, moving > MOVES)
    less = _visible_parts(initial & ~mask, moving < -MOVES)
    return int(np.count_nonzero(more | less)) / max(int(np.count_nonzero(mask)), 1)


def _visible_parts(where: NDArray[np.bool_], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(S, S)`` the connected parts in which enough is seen of a motion."""
    count, part = cv2.connectedComponents(where.astype(np.uint8))
    dense = np.bincount(part[seen], minlength=count) >= _DENSE * np.bincount(part.ravel(), minlength=count)
    dense[0] = False
    return np.asarray(dense[part])


def _touching(where: NDArray[np.bool_], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(S, S)`` the connected parts that lie against what is known."""
    _, part = cv2.connectedComponents(where.astype(np.uint8))
    beside = np.unique(part[cv2.dilate(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0])
    return np.isin(part, beside) & where


def _disc(radius: float) -> NDArray[np.uint8]:
    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)


def unlike_surroundings(lab: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """``(S, S)`` log of how rare a colour is in the background: an arm goes on where the object has ended."""
    distance = relative_distance(known)
    far = distance < -_FAR
    if not far.any():
        return np.zeros(known.shape, np.float32)
    return log_ratio(histograms(lab, known, far), lab, _RARE)
