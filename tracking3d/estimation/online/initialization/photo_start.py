"""Structure from motion of an object alone, from photos that are taken from far apart and in any order.

Points that are followed from frame to frame do not last through steps of 10 degrees and more, as of photos on a
turntable. Keypoints that are matched do. Two photos do not tell the turn between them while the lens is not known;
three do (`structure_hypotheses`, under several lenses). To these the others are added one by one, each by the pose of
the points that it shares (PnP), and all is adjusted together with the focal length (Snavely et al., "Photo tourism",
2006). Several pairings of the photos compete, since an object may look alike from two sides, and two kinds of
keypoints.

Whether the outcome is reliable is told by what was not fitted: the same outlines carved from all photos must fill the
mask of each, a photo must show points that face it, and the reversal in depth must fit clearly worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.initialization.initial_map import InitialMap
from tracking3d.estimation.online.initialization.photo_tracks import (
    SAME_PLACE,
    Matches,
    Pair,
    Photo,
    join_tracks,
    match_photos,
    neighbouring_pairs,
)
from tracking3d.estimation.online.initialization.structure_from_motion import (
    image_deformation,
    structure_hypotheses,
    subset_of,
)
from tracking3d.estimation.online.mapping.focal_length import with_focal_length
from tracking3d.estimation.online.mapping.local_mapping import fit_shape
from tracking3d.estimation.online.optimization.pnp import pose_from_points
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.shape import RADIUS
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_arrays, pose_from_arrays
from tracking3d.points.bundle_adjustment.adjustment import Structure, Tracks, adjust, reversal_of
from tracking3d.points.bundle_adjustment.reprojection import FloatArray, transform_to_camera

MOST_PHOTOS = 60
"""Photos that are joined at once (chosen: all pairs of them are matched in a minute)."""
_NEIGHBOURS = 2  # places within which photos are neighbours (measured: the pot and the car)
_FIELDS_OF_VIEW = (45.0, 27.0, 65.0, 16.0)  # degrees, vertical, of the lenses that are tried
_THRESHOLD, _LEAST_THRESHOLD = 0.006, 1.0  # largest residual as a share of the object's length, and in pixels
_COMMON, _COMMON_IN_ALL = 10, 8  # points that two and all three of three photos share at least
# Threes of photos that are tried and looked at; structures of each
_TRIPLES, _MOST_TRIPLES, _STRUCTURES = 6, 150, 3
_ENOUGH_POINTS, _ENOUGH_DEFORMATION = 60, 0.3  # of three photos, from which more makes no better start
_SEED_PHOTOS, _GROWN = 6, 6  # photos up to which every start grows, and how many of the starts grow on
_SHARED_POINTS = 5  # known points in a photo from which it can be added
# Observations of an added photo that fit, and their share of those that could
_LEAST_POINTS, _LEAST_SHARE = 10, 0.5
# Points that two photos share at least, and the share that fits if they agree
_LINK_POINTS, _LINK_SHARE = 8, 0.65
_COMMON_OF_PIECES = 3  # points that two structures know in the photo they share, to tell their sizes (chosen)
_CLEAR_SHARE = 0.8  # share of the observations from which no other pose of a photo is tried (chosen)
_ENOUGH_JOINED = 0.9  # share of the photos from which no other start is tried (chosen)
_ROUNDS = 3
_AGAIN = 1.3  # times as many points for another attempt
_LEAST_ANGLE = 2.0  # degrees between the rays of a point
_FOCAL_PHOTOS = 4  # from which the focal length is free
_SHORTEST, _LONGEST = 1.2, 14.0  # focal lengths in halves of the height: 80 and 8 degrees
# A structure is reliable (measured on seven sets, right ones and wrong ones): most of its cost, the ratio of the costs
# of its reversal and itself and the facing either of which is evidence enough, and the least share of masks filled.
_FEWEST_PHOTOS, _HIGHEST_COST, _CLEAR_RATIO, _CLEAR_FACING, _LEAST_FILLED = 4, 0.3, 1.5, 0.2, 0.95
_LEAST_JOINED = 0.4  # share of the photos that is joined at least (chosen)
_MOST_JOINED = 0.9  # share of the photos from which no other pairing or keypoints are tried (chosen)
# Degrees between the turns of two structures that confirm each other, and in which share of their photos (chosen)
_ALIKE, _ALIKE_SHARE = 3.0, 0.9
_MANY_SHARED = 25  # matches of neighbours, at the median, from which it is not points that lack (chosen)
# The block that silhouettes are carved out of: cells along a side, half a side in root mean square distances of the
# points from their middle, share of the photos that must show a cell inside, and cells that a cell covers in a photo
# (chosen).
_GRID, _BLOCK, _VOTES, _CELL = 64, 2.5, 0.9, 1.2


@dataclass(frozen=True, eq=False)
class PhotoTracks:
    """The points that photos share, and how they are fitted."""

    tracks: Tracks
    threshold: float  # largest residual of an inlier in pixels
    free_focal: bool = True  # whether the focal length is to be found, too

    @property
    def visible(self) -> NDArray[np.bool_]:
        """``(F, N)`` which photo shows which point."""
        return self.tracks.visible

    @property
    def pixels(self) -> FloatArray:
        """``(F, N, 2)``."""
        return self.tracks.pixels


@dataclass(frozen=True, eq=False)
class PhotoStructure:
    """Photos that were joined, and the points that they share."""

    photos: tuple[int, ...]  # places of the joined photos, in the order in which they were joined
    R: FloatArray  # (F, 3, 3) and t (F, 3) of every photo; only those of joined ones mean anything
    t: FloatArray
    points: FloatArray  # (N, 3); nan for those that are not known
    seen: NDArray[np.bool_]  # (F, N) the observations that fit
    K: FloatArray  # (3, 3)
    cost: float = math.inf  # mean Cauchy loss of the observations
    joints: frozenset[int] = frozenset()  # photos by which alone structures were merged

    @property
    def order(self) -> NDArray[np.intp]:
        """`photos` as indices."""
        return np.array(self.photos, np.intp)

    @property
    def known(self) -> NDArray[np.bool_]:
        """``(N,)`` points that are known."""
        return np.asarray(np.isfinite(self.points).all(1))

    @property
    def observations(self) -> NDArray[np.bool_]:
        """``(F, N)`` of known points in joined photos."""
        joined = np.zeros((len(self.R), 1), bool)
        joined[self.order] = True
        return self.seen & joined & self.known

    @property
    def support(self) -> float:
        """How many observations fit, and how well."""
        return float(np.count_nonzero(self.observations) * math.exp(-self.cost))


def triangulate(tracks: PhotoTracks, found: PhotoStructure) -> PhotoStructure:
    """Add the points that two or more joined photos show from directions apart, and that fit all of them."""
    order = found.order
    seen = found.seen[order] & ~found.known
    new = np.flatnonzero(seen.sum(0) >= 2)
    if not len(new):
        return found
    seen, pixels = seen[:, new], np.nan_to_num(tracks.pixels[np.ix_(order, new)])
    P = found.K @ np.concatenate([found.R[order], found.t[order][..., None]], 2)
    rows = pixels[..., None] * P[:, None, None, 2] - P[:, None, :2]
    rows *= seen[..., None, None] / np.linalg.norm(rows, axis=-1, keepdims=True).clip(1e-12)
    homogeneous = np.linalg.eigh(np.einsum("fnai,fnaj->nij", rows, rows))[1][..., 0]
    divisor = homogeneous[:, 3:]
    points = homogeneous[:, :3] / np.where(np.abs(divisor) < 1e-12, np.nan, divisor)
    projected = np.einsum("fij,nj->fni", P[..., :3], points) + P[:, None, :, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = np.linalg.norm(projected[..., :2] / projected[..., 2:] - pixels, axis=2)
        fits = ((projected[..., 2] > 0) & (residual <= 2 * tracks.threshold)) | ~seen
    centres = -np.einsum("fji,fj->fi", found.R[order], found.t[order])
    rays = points - centres[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    cosine = np.einsum("fni,gni->nfg", np.nan_to_num(rays), np.nan_to_num(rays))
    both = seen.T[:, :, None] & seen.T[:, None]
    apart = np.where(both, cosine, 1.0).min((1, 2)) < math.cos(math.radians(_LEAST_ANGLE))
    good = fits.all(0) & apart & np.isfinite(points).all(1)
    every = found.points.copy()
    every[new[good]] = points[good]
    return replace(found, points=every)


def adjust_all(tracks: PhotoTracks, found: PhotoStructure, iterations: int) -> PhotoStructure:
    """Poses, points and focal length adjusted together; observations that do not fit are left out."""
    order = found.order
    used = np.flatnonzero(found.known & (found.seen[order].sum(0) >= 2))
    if len(used) < _LEAST_POINTS:
        return replace(found, cost=math.inf)
    at = np.ix_(order, used)
    part, start = (
        Tracks(tracks.pixels[at], found.seen[at]),
        Structure(found.R[order], found.t[order], found.points[used]),
    )
    free = tracks.free_focal and len(order) >= _FOCAL_PHOTOS
    solved = adjust(part, found.K, start, scale=tracks.threshold / 2, iterations=iterations, free_focal=free)
    if not _SHORTEST < found.K[1, 1] * solved.focal_factor / found.K[1, 2] < _LONGEST:
        solved = adjust(part, found.K, start, scale=tracks.threshold / 2, iterations=iterations)
    R, t, seen = found.R.copy(), found.t.copy(), found.seen.copy()
    R[order], t[order] = solved.R, solved.t
    seen[at] &= ~(np.nan_to_num(solved.residual) > 2 * tracks.threshold)
    points = np.full_like(found.points, np.nan)
    points[used] = np.where(seen[at].sum(0)[:, None] >= 2, solved.points, np.nan)
    K = found.K * [[solved.focal_factor, 1, 1], [1, solved.focal_factor, 1], [1, 1, 1]]
    return replace(found, R=R, t=t, points=points, seen=seen, K=K, cost=solved.cost)


def add_photo(tracks: PhotoTracks, found: PhotoStructure, photo: int) -> PhotoStructure | None:
    """Add a photo by the points that it shares, or by a turn like its neighbours'; None if it does not fit then.

    A pose is kept if most of what the photo shares with the joined ones fits after all are adjusted: points that were
    known, and those that only it and one other show, which say something of the pose too.
    """
    shared = np.flatnonzero(tracks.visible[photo] & found.known)
    points, pixels = found.points[shared], tracks.pixels[photo, shared]
    poses = [pose_from_points(points, pixels, found.K, threshold=1.5 * tracks.threshold, seed=0)]
    for start in _continued_motion(found, photo):
        poses.append(pose_from_points(points, pixels, found.K, start, threshold=3 * tracks.threshold, seed=0))
    common = tracks.visible[photo] & tracks.visible[found.order].any(0)
    best: PhotoStructure | None = None
    most: float = max(_LEAST_POINTS, _LEAST_SHARE * np.count_nonzero(common))
    for pose in poses:
        if pose is None or transform_to_camera(pose.R, pose.t, points)[pose.inliers, 2].min() <= 0:
            continue
        R, t, seen = found.R.copy(), found.t.copy(), found.seen.copy()
        R[photo], t[photo] = pose.R, pose.t
        seen[photo] = tracks.visible[photo]
        added = replace(found, photos=(*found.photos, photo), R=R, t=t, seen=seen)
        added = adjust_all(tracks, triangulate(tracks, added), 8)
        count = int(np.count_nonzero(added.observations[photo]))
        linked = _links(tracks, added)
        if count >= most and linked[np.ix_(linked[photo], linked[photo])].any():
            best, most = added, count
            if count >= _CLEAR_SHARE * np.count_nonzero(common):
                break
    return best


def _links(tracks: PhotoTracks, found: PhotoStructure) -> NDArray[np.bool_]:
    """``(F, F)`` which joined photos agree: most of the points that are matched between them fit both."""
    fits = found.observations
    there = (tracks.visible & np.any(fits, axis=1, keepdims=True)).astype(int)
    common, kept = there @ there.T, fits.astype(int) @ fits.T.astype(int)
    linked: NDArray[np.bool_] = (common >= _LINK_POINTS) & (kept >= _LINK_SHARE * common)
    np.fill_diagonal(linked, False)
    return linked


def _connected(linked: NDArray[np.bool_], joints: frozenset[int]) -> set[int]:
    """The most photos that hang together by threes of which all agree, neighbouring threes sharing two, or a joint.

    A wrong pose mostly agrees with one neighbour, on which it was based, and not with the next one too.
    """
    triples = [
        triple
        for triple in combinations(np.flatnonzero(linked.any(1)).tolist(), 3)
        if all(linked[pair] for pair in combinations(triple, 2))
    ]
    groups: list[tuple[set[int], set[Pair]]] = []
    for triple in triples:
        photos, edges = set(triple), set(combinations(triple, 2))
        apart = []
        for group in groups:
            if group[1] & edges or group[0] & photos & joints:
                photos, edges = photos | group[0], edges | group[1]
            else:
                apart.append(group)
        groups = [*apart, (photos, edges)]
    return max((photos for photos, _ in groups), key=len, default=set())


def keep_connected(tracks: PhotoTracks, found: PhotoStructure) -> PhotoStructure:
    """Without photos that do not agree with the others."""
    kept = _connected(_links(tracks, found), found.joints)
    if not kept:
        return replace(found, cost=math.inf)
    if len(kept) == len(found.photos):
        return found
    photos = tuple(photo for photo in found.photos if photo in kept)
    seen = (
        tracks.visible
        & np.isin(np.arange(len(tracks.visible)), photos)[:, None]
        & (found.seen | ~found.known)
    )
    return adjust_all(tracks, replace(found, photos=photos, seen=seen), 15)


def _continued_motion(found: PhotoStructure, photo: int) -> list[tuple[FloatArray, FloatArray]]:
    """Poses of a photo that turns from its neighbour as far as that does from the next one, on either side."""
    starts = []
    count = len(found.R)
    for side in (-1, 1):
        near, next_one = (photo + side) % count, (photo + 2 * side) % count
        if near in found.photos and next_one in found.photos:
            R = found.R[near] @ found.R[next_one].T
            starts.append((R @ found.R[near], found.t[near] + R @ (found.t[near] - found.t[next_one])))
    return starts


def grow(tracks: PhotoTracks, found: PhotoStructure, most: int) -> PhotoStructure:
    """Add photos one by one, that with most shared points first, until there are ``most`` or none can be added."""
    failed: dict[int, float] = {}
    found = adjust_all(tracks, found, 15)
    while len(found.photos) < min(most, len(tracks.visible)):
        found = triangulate(tracks, found)
        shared = (tracks.visible & found.known).sum(1)
        shared[found.order] = 0
        waiting = [
            photo
            for photo in np.argsort(-shared, kind="stable").tolist()
            if shared[photo] >= max(_SHARED_POINTS, failed.get(photo, 0.0))
        ]
        if not waiting:
            break
        added = add_photo(tracks, found, waiting[0])
        if added is None:
            failed[waiting[0]] = _AGAIN * shared[waiting[0]] + 1
        else:
            found = added
    found = triangulate(tracks, found)
    for _ in range(2):
        found = adjust_all(tracks, found, 25)
    return keep_connected(tracks, found)


def seeds(tracks: PhotoTracks, cameras: Sequence[FloatArray]) -> list[PhotoStructure]:
    """Structures of three photos each, under each of the lenses ``(3, 3)``."""
    found = []
    for photos in _choose_triples(tracks):
        names = np.flatnonzero(tracks.visible[list(photos)].all(0))
        part = subset_of(tracks.tracks, np.array(photos), names)
        middle, extent = part.pixels[0].mean(0), float(np.ptp(part.pixels[0], axis=0).max())
        for K in cameras:
            depth = 2 * RADIUS * K[0, 0] / extent
            t0 = np.array([*((middle - K[:2, 2]) * depth / K[0, 0]), depth])
            for one in structure_hypotheses(
                part, K, t0, RADIUS, scale=tracks.threshold / 2, keep=_STRUCTURES
            ):
                frames, count = tracks.visible.shape
                R, t, points = (
                    np.tile(np.eye(3), (frames, 1, 1)),
                    np.zeros((frames, 3)),
                    np.full((count, 3), np.nan),
                )
                R[list(photos)], t[list(photos)], points[names] = one.R, one.t, one.points
                found.append(PhotoStructure(photos, R, t, points, tracks.visible.copy(), K, one.cost))
    return found


def _choose_triples(tracks: PhotoTracks) -> list[tuple[int, int, int]]:
    """Threes of photos that share many points, whose image changes its form; no two of them share two photos."""
    common = tracks.visible.astype(int) @ tracks.visible.T.astype(int)
    shared = []
    for triple in combinations(range(len(common)), 3):
        if min(common[a, b] for a, b in combinations(triple, 2)) >= _COMMON:
            count = int(np.count_nonzero(tracks.visible[list(triple)].all(0)))
            if count >= _COMMON_IN_ALL:
                shared.append((count, triple))
    shared.sort(reverse=True)
    scored = []
    for count, triple in shared[:_MOST_TRIPLES]:
        names = np.flatnonzero(tracks.visible[list(triple)].all(0))
        deformation = image_deformation(subset_of(tracks.tracks, np.array(triple), names))
        scored.append((min(count, _ENOUGH_POINTS) * min(deformation, _ENOUGH_DEFORMATION), triple))
    chosen: list[tuple[int, int, int]] = []
    for _, triple in sorted(scored, key=lambda one: -one[0]):
        if len(chosen) < _TRIPLES and all(len({*triple} & {*other}) < 2 for other in chosen):
            chosen.append(triple)
    return chosen


def solve_photos(tracks: PhotoTracks, cameras: Sequence[FloatArray]) -> list[PhotoStructure]:
    """Structures of as many photos as can be joined, each from another start, the best first."""
    begun = [grow(tracks, seed, _SEED_PHOTOS) for seed in seeds(tracks, cameras)]
    begun = [one for one in begun if math.isfinite(one.cost)]
    begun.sort(key=lambda one: (-min(len(one.photos), _SEED_PHOTOS), -one.support))
    grown = []
    for one in begun[:_GROWN]:
        for _ in range(_ROUNDS):
            before = len(one.photos)
            one = grow(tracks, one, len(tracks.visible))
            if len(one.photos) <= before or not math.isfinite(one.cost):
                break
        if math.isfinite(one.cost):
            grown.append(one)
        if len(one.photos) >= _ENOUGH_JOINED * len(tracks.visible):
            return sorted(grown, key=_rank)
    pieces = {frozenset(one.photos): one for one in sorted([*grown, *begun], key=_rank, reverse=True)}
    if len(pieces) > 1:
        whole = _merge_all(tracks, [_upright(tracks, one)[0] for one in sorted(pieces.values(), key=_rank)])
        grown.append(grow(tracks, whole, len(tracks.visible)))
    return sorted((one for one in grown if math.isfinite(one.cost)), key=_rank)


def _rank(found: PhotoStructure) -> tuple[float, float]:
    return -len(found.photos), -found.support


def _merge_all(tracks: PhotoTracks, pieces: Sequence[PhotoStructure]) -> PhotoStructure:
    """The first of several structures, with all that can be merged into it."""
    whole, before = pieces[0], 0
    while before < len(whole.photos):
        before = len(whole.photos)
        for piece in pieces[1:]:
            made = merge(tracks, whole, piece)
            if made is not None and {*made.photos} > {*whole.photos}:
                whole = made
    return whole


def merge(tracks: PhotoTracks, one: PhotoStructure, other: PhotoStructure) -> PhotoStructure | None:
    """Two structures that share a photo; None if it is all of one of them, or they do not fit.

    Where sides of a box follow each other in wide steps, the photo of an edge has many points in common with those
    before and after it, which have none with each other: no point is seen in three. Of the two structures only the
    ratio of their sizes is open: points that both know tell it, or how far those of each are from the shared photo.
    """
    shared, new = [*{*one.photos} & {*other.photos}], [q for q in other.photos if q not in one.photos]
    if not (shared and new and len(shared) < len(one.photos)):
        return None
    shown = one.observations.sum(1), other.observations.sum(1)
    joint = max(shared, key=lambda photo: min(int(count[photo]) for count in shown))
    R0, t0, R1, t1 = one.R[joint], one.t[joint], other.R[joint], other.t[joint]
    from_one, from_other = transform_to_camera(R0, t0, one.points), transform_to_camera(R1, t1, other.points)
    both = one.known & other.known & tracks.visible[joint]
    ratio = from_one[both, 2] / from_other[both, 2]
    if len(ratio) < _COMMON_OF_PIECES:
        near, far = from_one[one.observations[joint], 2], from_other[other.observations[joint], 2]
        ratio = np.median(near) / far
    size = float(np.median(ratio))
    R, t, points, seen = one.R.copy(), one.t.copy(), one.points.copy(), one.seen.copy()
    for photo in new:
        turn = other.R[photo] @ R1.T
        R[photo], t[photo] = turn @ R0, turn @ t0 + size * (other.t[photo] - turn @ t1)
    gained = other.known & ~one.known
    points[gained] = (size * from_other[gained] - t0) @ R0
    seen[new] = tracks.visible[new]
    joints = one.joints | other.joints | {joint}
    made = replace(one, photos=(*one.photos, *new), R=R, t=t, points=points, seen=seen, joints=joints)
    for _ in range(2):
        made = adjust_all(tracks, triangulate(tracks, made), 25)
    made = keep_connected(tracks, made)
    return made if math.isfinite(made.cost) else None


def reverse(tracks: PhotoTracks, found: PhotoStructure) -> PhotoStructure:
    """The same photos and points, reversed in depth and adjusted."""
    order, known = found.order, found.known
    T = np.tile(np.eye(4), (len(order), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = found.R[order], found.t[order]
    reversal = reversal_of(found.points[known], T[0])
    turned = reversal.poses(T)
    R, t, points = found.R.copy(), found.t.copy(), found.points.copy()
    R[order], t[order], points[known] = turned[:, :3, :3], turned[:, :3, 3], reversal.points(points[known])
    return adjust_all(tracks, replace(found, R=R, t=t, points=points), 40)


def facing(found: PhotoStructure) -> float:
    """How much nearer the points are that a photo shows than the middle of all of them, in their root mean square
    distance from it; a solution that is reversed in depth shows its far side."""
    middle = np.nanmean(found.points, axis=0)
    size = math.sqrt(float(np.nanmean(np.sum((found.points - middle) ** 2, 1))))
    nearer = [
        -float(np.mean((found.points[found.observations[photo]] - middle) @ found.R[photo, 2]))
        for photo in found.photos
        if found.observations[photo].any()
    ]
    return float(np.mean(nearer)) / max(size, 1e-12)


def overlap_of_hull(photos: Sequence[Photo], found: PhotoStructure) -> float:
    """How much of the masks is filled by what they leave when they are carved out of a block, the mean of all photos.

    Poses that are wrong carve away what other photos show (silhouette coherence, Hernandez et al. 2007).
    """
    middle = np.nanmean(found.points, axis=0)
    size = math.sqrt(float(np.nanmean(np.sum((found.points - middle) ** 2, 1))))
    axis = (np.arange(_GRID) + 0.5) / _GRID * 2 - 1
    cells = middle + _BLOCK * size * np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    places, votes = [], np.zeros(len(cells), int)
    for photo in found.photos:
        seen = transform_to_camera(found.R[photo], found.t[photo], cells)
        pixels = seen[:, :2] / seen[:, 2:] * found.K[[0, 1], [0, 1]] + found.K[:2, 2]
        place = photos[photo].silhouette.places(pixels)
        votes += photos[photo].silhouette.inside[place[:, 1], place[:, 0]]
        places.append(place)
    left = votes >= _VOTES * len(found.photos)
    filled = []
    for photo, place in zip(found.photos, places, strict=True):
        inside = photos[photo].silhouette.inside
        drawn = np.zeros(inside.shape, np.uint8)
        drawn[place[left, 1], place[left, 0]] = 1
        depth = float((found.R[photo] @ middle + found.t[photo])[2])
        cell = 2 * _BLOCK * size / _GRID * found.K[1, 1] / depth * photos[photo].silhouette.scale
        width = 2 * math.ceil(_CELL * cell / 2) + 1
        drawn = cv2.dilate(drawn, np.ones((width, width), np.uint8))
        filled.append(float(drawn[inside].mean()))
    return float(np.mean(filled))


@dataclass(frozen=True, eq=False)
class PhotoStart:
    """What came of a set of photos."""

    tracks: PhotoTracks
    structure: PhotoStructure | None  # None if none is reliable
    reason: str  # which photos are not joined, and what to do about that; empty if all are

    @property
    def joined(self) -> set[int]:
        """Places of the joined photos."""
        return set() if self.structure is None else {*self.structure.photos}


def start_of_photos(kinds: Sequence[Sequence[Photo]], camera: Camera) -> PhotoStart:
    """Join photos of one object, as many as can be.

    Args:
        kinds: The photos, in the order in which they were most likely taken, at most `MOST_PHOTOS`; once for each kind
            of keypoints.
        camera: The camera of all; if its focal length is assumed, others are tried and the best is found.
    """
    count = len(kinds[0])
    threshold = max(_LEAST_THRESHOLD, _THRESHOLD * float(np.median([photo.length for photo in kinds[0]])))
    cameras = [camera.K]
    if camera.assumed:
        cameras = [
            camera.zoom(Camera.from_fov(camera.width, camera.height, angle).fy / camera.fy, "").K
            for angle in _FIELDS_OF_VIEW
        ]
    best: PhotoStart | None = None
    matches: list[Matches] = [{} for _ in kinds]
    tried = list[tuple[int, PhotoTracks, PhotoStructure, float]]()
    pairings = neighbouring_pairs(count, _NEIGHBOURS), list(combinations(range(count), 2))
    for pairs, (kind, photos) in product(pairings, enumerate(kinds)):
        found = match_photos(photos, set(pairs) - matches[kind].keys(), cameras[0], threshold)
        matches[kind] = {**matches[kind], **found}
        tracks = PhotoTracks(join_tracks(photos, matches[kind]), threshold, camera.assumed)
        tried += [(kind, tracks, *_upright(tracks, one)) for one in solve_photos(tracks, cameras)]
        for of, its_tracks, one, evidence in tried:
            if best is not None and len(one.photos) <= len(best.joined):
                continue
            confirmed = any(agree(one, other) for other_kind, _, other, _ in tried if other_kind != of)
            # Further keypoints alone must join nearly all: on the pot, those of the network join 5 and 7 of 12 wrongly.
            believed = not of or confirmed or len(one.photos) >= _MOST_JOINED * count
            if believed and is_reliable(photos, one, evidence, confirmed):
                best = PhotoStart(its_tracks, one, "")
        if best is not None and len(best.joined) >= _MOST_JOINED * count:
            break
    best = best or PhotoStart(PhotoTracks(join_tracks(kinds[0], {}), threshold), None, "")
    return replace(best, reason=_why_not_joined(kinds[0], matches, best.joined))


def agree(one: PhotoStructure, other: PhotoStructure) -> bool:
    """Whether two structures, of keypoints of two kinds, turn their common photos alike."""
    common = sorted({*one.photos} & {*other.photos})
    if len(common) < _FEWEST_PHOTOS:
        return False
    turns = Rotation.from_matrix(one.R[common].transpose(0, 2, 1) @ other.R[common])
    apart = (turns.mean().inv() * turns).magnitude()
    return bool(np.degrees(np.quantile(apart, _ALIKE_SHARE)) < _ALIKE)


def _upright(tracks: PhotoTracks, found: PhotoStructure) -> tuple[PhotoStructure, float]:
    """The better of a structure and its reversal in depth, and the evidence that it is that one: 1 is enough."""
    other = reverse(tracks, found)
    if other.cost < found.cost:
        found, other = other, found
    ratio = min(other.cost / max(found.cost, 1e-9), _CLEAR_RATIO**3)
    return found, math.log(ratio) / math.log(_CLEAR_RATIO) + facing(found) / _CLEAR_FACING


def is_reliable(
    photos: Sequence[Photo], found: PhotoStructure, evidence: float, confirmed: bool = False
) -> bool:
    """Whether photos are joined as the object has turned: points and outlines fit, and it is not reversed in depth.

    If other keypoints have ``confirmed`` how it turned, the points may fit worse.
    """
    return (
        len(found.photos) >= max(_FEWEST_PHOTOS, _LEAST_JOINED * len(photos))
        and (confirmed or found.cost < _HIGHEST_COST)
        and evidence >= 1
        and overlap_of_hull(photos, found) >= _LEAST_FILLED
    )


def _why_not_joined(photos: Sequence[Photo], matches: Sequence[Matches], joined: set[int]) -> str:
    """Which photo is not joined, in words, by its matches of each kind; empty if all are."""
    count = len(photos)
    if len(joined) == count:
        return ""
    shared = np.zeros((count, count), int)
    for pair, matched in chain(*(kind.items() for kind in matches)):
        shared[pair] = shared[pair[::-1]] = max(shared[pair], len(matched))

    def beside(photo: int) -> list[int]:
        return [place for place in (photo - 1, photo + 1) if 0 <= place < count]

    missing = [photo for photo in range(count) if photo not in joined]
    near = [photo for photo in missing if any(place in joined for place in beside(photo))] or missing
    worst = min(near, key=lambda photo: float(np.mean(shared[photo, beside(photo)])))
    how_many = f"{count} photos, {len(joined) or 'none'} joined"
    if np.median([shared[a, a + 1] for a in range(count - 1)]) >= _MANY_SHARED and not joined:
        return f"{how_many}; points on it do not move as one solid (reflections?)"
    names = " and ".join(str(photos[place].index) for place in beside(worst))
    return (
        f"{how_many}; photo {photos[worst].index} shares too few points with photo"
        f"{'s' if len(beside(worst)) > 1 else ''} {names}: take one every 20 degrees or less"
    )


def initial_map_of_photos(
    object_map: ObjectMap,
    start: PhotoStart,
    photos: Sequence[Photo],
    views: Sequence[Keyframe],
    camera: Camera,
    weights: FitWeights,
) -> tuple[InitialMap, list[Keyframe]]:
    """The first map of joined photos, in the object's unit, and all views with the points that they show of it.

    Args:
        object_map: Prototype and landmarks; its keyframes are not used.
        start: The joined photos.
        photos: All photos that were tried, and
        views: the same as views, each with a pose that places the object at the depth of its mask.
        camera: The camera of the views.
        weights: The weights of the shape's terms.
    """
    found, tracks = start.structure, start.tracks
    assert found is not None
    solved = camera.with_solved_focal(float(found.K[1, 1] / camera.fy)) if camera.assumed else camera
    first = min(found.photos)
    R0, t0 = found.R[first], found.t[first]
    middle = np.nanmedian(found.points, axis=0)
    _, placed = pose_arrays(with_focal_length(views[first], camera, solved).pose)
    size = float(placed[2]) / float((R0 @ middle + t0)[2])
    base = len(object_map.landmarks)
    landmarks = np.concatenate([object_map.landmarks, size * (found.points - middle) @ R0.T])
    candidate = np.concatenate([object_map.candidate, np.zeros(len(found.points), bool)])
    shown, keyframes = [], []
    for place, (photo, view) in enumerate(zip(photos, views, strict=True)):
        names = np.flatnonzero(found.observations[place])
        points = FollowedPoints(
            (base + names).astype(np.int64), tracks.pixels[place, names].astype(np.float32)
        )
        shown.append(replace(view, points=points, texture=None, **_labelled_keypoints(photo, points)))
        if place in found.photos:
            translation = size * (found.R[place] @ middle + found.t[place])
            pose = pose_from_arrays(found.R[place] @ R0.T, translation, object_map.vertices)
            keyframes.append(replace(with_focal_length(shown[-1], camera, solved), pose=pose))
    object_map = replace(object_map, landmarks=landmarks, candidate=candidate, keyframes=tuple(keyframes))
    object_map = fit_shape(object_map, list(range(len(keyframes))), weights, 4)
    return InitialMap(object_map, found.cost, found.cost, "photos", solved), shown


def _labelled_keypoints(photo: Photo, points: FollowedPoints) -> dict[str, Any]:
    """The keypoints of a photo as it is, as a keyframe has them, with the landmarks that they show."""
    keypoints = photo.keypoints[0]
    if not (len(keypoints) and len(points)):
        return {"keypoints": Keypoints.none(), "keypoint_landmark": np.zeros(0, np.int64)}
    gap, nearest = KDTree(points.pixel).query(keypoints.pixel)
    return {
        "keypoints": keypoints,
        "keypoint_landmark": np.where(gap < SAME_PLACE, points.landmark[nearest], -1).astype(np.int64),
    }
