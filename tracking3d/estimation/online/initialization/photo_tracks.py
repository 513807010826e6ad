"""Points of an object in photos that may be taken from far apart: keypoints inside the masks, matched and joined.

Of a thing on a turntable the background stands still, and what stands still in the picture lies about the thing: its
rim, its outline, the plate. So only keypoints inside the masks count, and of their matches only those that move.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.sift import SIFT, Detector, Keypoints, detect_turned, match
from tracking3d.points.bundle_adjustment.adjustment import Tracks
from tracking3d.points.bundle_adjustment.reprojection import FloatArray

# Of a photo, which has few neighbours (measured: 14 of 20 photos of the car are joined, with half as many keypoints 9).
# Contrast and the ratio's distance from 1 are shares of the usual ones.
_LOOSER = 0.75
_ONCE: dict[str, Any] = {"most": 1000, "size": 600, "contrast": 0.25}
# In each of several turns (measured: 20 photos of the car are joined, and 19 with as many as above).
_IN_TURNS: dict[str, Any] = {"most": 500, "size": 400, "contrast": 1.0}
_STILL = 0.03  # share of the object's length; matches that move by less stand still (measured on the pot)
_SILHOUETTE_SIZE = 160  # pixels along the longer side of a silhouette (chosen)
_FEWEST_MATCHES, _LEAST_SHARE = 10, 0.15  # inliers of a pair, and their share of its matches (chosen)
_SAME_PIXELS = 2.0  # matches within a square of so many pixels count as one (chosen)
SAME_PLACE = 1.5  # pixels within which keypoints are one place (as in the start of a video)
_ITERATIONS, _CONFIDENCE = 1000, 0.999  # of the sampling of essential matrices

Pair = tuple[int, int]
Matches = Mapping[Pair, NDArray[np.int64]]
"""For each pair of photos ``(M, 2)`` places of matched keypoints in both."""


@dataclass(frozen=True, eq=False)
class PhotoSilhouette:
    """The mask of a photo around the object, scaled down."""

    inside: NDArray[np.bool_]  # (h, w), with an empty border
    corner: FloatArray  # (2,) x and y in the photo of the outer corner of its first pixel
    scale: float  # its pixels for one pixel of the photo

    @classmethod
    def of(cls, mask: NDArray[np.bool_]) -> PhotoSilhouette:
        """The silhouette of a mask ``(H, W)`` that is not empty."""
        x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
        scale = min(_SILHOUETTE_SIZE / max(width, height), 1.0)
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        small = cv2.resize(
            mask[y : y + height, x : x + width].astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA
        )
        return cls(np.pad(small > 127, 1), np.array([x - 0.5, y - 0.5]) - 1 / scale, scale)

    def places(self, pixels: FloatArray) -> NDArray[np.int64]:
        """``(..., 2)`` column and row of pixels of the photo; those outside are on the empty border."""
        place = np.floor((pixels - self.corner) * self.scale).astype(np.int64)
        return np.clip(place, 0, np.array(self.inside.shape[::-1]) - 1)


@dataclass(frozen=True, eq=False)
class Photo:
    """What is known of one photo."""

    index: int  # in the source
    keypoints: tuple[Keypoints, ...]  # of each turn, see `detect_turned`
    silhouette: PhotoSilhouette
    length: float  # pixels of the object's longer side

    @classmethod
    def of(
        cls, index: int, grey: NDArray[np.uint8], mask: NDArray[np.bool_], detector: Detector = SIFT
    ) -> Photo:
        """Find the keypoints of a grey photo ``(H, W)`` inside a mask ``(H, W)`` that is not empty."""
        *_, width, height = cv2.boundingRect(mask.astype(np.uint8))
        how = _ONCE if detector.rotation_invariant else _IN_TURNS
        found = detect_turned(grey, mask, detector, **how)
        return cls(index, found, PhotoSilhouette.of(mask), float(max(width, height)))

    @property
    def pixels(self) -> FloatArray:
        """``(K, 2)`` the keypoints of all turns, one after the other."""
        return np.concatenate([one.pixel for one in self.keypoints]).astype(np.float64)


def neighbouring_pairs(count: int, distance: int) -> list[Pair]:
    """Pairs of photos that follow each other within some places, the last ones being followed by the first."""
    return [(a, b) for a, b in combinations(range(count), 2) if min(b - a, count - (b - a)) <= distance]


def match_photos(
    photos: Sequence[Photo],
    pairs: Iterable[Pair],
    K: FloatArray,
    threshold: float,
) -> Matches:
    """The matches of pairs of photos that move in the picture, and between two views of one solid.

    Args:
        photos: The photos.
        pairs: Which of them are compared.
        K: ``(3, 3)`` of a likely lens; it matters little.
        threshold: Largest distance in pixels from the epipolar line.
    """
    found = {}
    length = float(np.median([photo.length for photo in photos]))
    pixels = [photo.pixels for photo in photos]
    for a, b in pairs:
        matched = _match_pair(photos[a], photos[b])
        x, y = pixels[a][matched[:, 0]], pixels[b][matched[:, 1]]
        moving = np.linalg.norm(x - y, axis=1) > _STILL * length
        matched, x, y = matched[moving], x[moving], y[moving]
        if len(matched) < _FEWEST_MATCHES:
            continue
        E, inlier = cv2.findEssentialMat(
            x, y, K, method=cv2.USAC_MAGSAC, prob=_CONFIDENCE, threshold=threshold, maxIters=_ITERATIONS
        )
        if E is None or E.shape != (3, 3):
            continue
        inside = inlier.ravel() > 0
        count = len(np.unique(np.round(x[inside] / _SAME_PIXELS), axis=0))
        if count >= max(_FEWEST_MATCHES, _FEWEST_MATCHES / 2 + _LEAST_SHARE * len(matched)):
            found[a, b] = matched[inside]
    return found


def _match_pair(a: Photo, b: Photo) -> NDArray[np.int64]:
    """``(M, 2)`` places in `Photo.pixels`: the first photo as it is with the turn of the second that matches best."""
    before = np.cumsum([0, *map(len, b.keypoints[:-1])])
    turns = zip(b.keypoints, before, strict=True)
    return max(
        (match(a.keypoints[0], there, _LOOSER) + np.array([0, first]) for there, first in turns), key=len
    )


def join_tracks(photos: Sequence[Photo], matches: Matches) -> Tracks:
    """Tracks of the points that are matched through the photos, each with one place in a photo.

    The matches of pairs that share most are taken first; one that would give a point two places in a photo is left
    out. Keypoints of one place, at several scales and orientations, are one.
    """
    places: list[NDArray[np.int64]] = []
    owner, pixel = list[int](), list[FloatArray]()
    for number, photo in enumerate(photos):
        grid, first, place = np.unique(
            np.round(photo.pixels / SAME_PLACE).astype(np.int64),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        places.append(place.ravel() + len(owner))
        owner += [number] * len(grid)
        pixel += list(photo.pixels[first])
    track = list(range(len(owner)))
    members = [{owner[place]: place} for place in track]
    for (a, b), matched in sorted(matches.items(), key=lambda one: (-len(one[1]), one[0])):
        for i, j in matched:
            one, other = track[places[a][i]], track[places[b][j]]
            if one == other or members[one].keys() & members[other].keys():
                continue
            if len(members[one]) < len(members[other]):
                one, other = other, one
            for place in members[other].values():
                track[place] = one
            members[one] |= members[other]
            members[other] = {}
    joined = [group for group in members if len(group) >= 2]
    pixels = np.full((len(photos), len(joined), 2), np.nan)
    for number, group in enumerate(joined):
        for shown_in, node in group.items():
            pixels[shown_in, number] = pixel[node]
    return Tracks(pixels, np.isfinite(pixels[..., 0]))
