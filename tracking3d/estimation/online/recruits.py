"""Points beside the mask that move with the object: they belong to it, and say where the mask is too small.

Corners around the mask are followed like the object's own. Once a few keyframes show one, it is triangulated with
their poses: a point of the object fits them and has moved in the image; one of the background fits only while
nothing moves. Where the object stands still and the camera moves, everything fits: then nobody is recruited, but
candidates tell the pose.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.bundle_adjustment.adjustment import Structure, adjust
from tracking3d.bundle_adjustment.reprojection import project_camera_points, transform_to_camera
from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.mapping import pose_arrays, tracks_of
from tracking3d.estimation.online.points import FollowedPoints, new_corners
from tracking3d.geometry.camera import Camera

MOST_CANDIDATES = 100
_REACH = 0.25  # how far beside the mask, relative to the root of its area
_VIEWS = 3
_FITS, _FAILS = 1.0, 2.5  # mean residual in pixels of an object 200 pixels large
_MOVED = 6.0  # such pixels
_STAYS = 0.3  # of the way that the object would have carried it
_SECTORS = 8  # that the surroundings are divided into
_STILL = (
    0.6  # share of the candidates of a sector, and of the sectors, that fit where the scene is a still one
)
_FEWEST_SECTORS, _FEWEST = 5, 3  # sectors that tell, and candidates that make one tell


def surroundings(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(H, W)`` the band around a mask."""
    reach = max(round(_REACH * float(np.sqrt(mask.sum()))), 3)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return (cv2.dilate(mask.astype(np.uint8), kernel) > 0) & ~mask


def with_candidates(known: ObjectMap, view: View, image: NDArray[np.uint8]) -> tuple[ObjectMap, View]:
    """With corners beside a view's mask."""
    if view.mask is None:
        return known, view
    there = int(known.candidate[view.points.landmark].sum())
    corners = new_corners(image, surroundings(view.mask), view.points.pixel, MOST_CANDIDATES - there)
    names = len(known.landmarks) + np.arange(len(corners))
    points = FollowedPoints(
        np.concatenate([view.points.landmark, names]), np.concatenate([view.points.pixel, corners])
    )
    known = replace(
        known,
        landmarks=np.concatenate([known.landmarks, np.full((len(corners), 3), np.nan)]),
        candidate=np.concatenate([known.candidate, np.ones(len(corners), bool)]),
    )
    return known, replace(view, points=points)


def recruit(known: ObjectMap, camera: Camera, positions: list[int]) -> ObjectMap:
    """Take candidates over as landmarks, or drop them, where the keyframes at ``positions`` can tell."""
    views = [known.keyframes[position] for position in positions]
    names, counts = np.unique(np.concatenate([view.points.landmark for view in views]), return_counts=True)
    names = names[(counts >= 2) & known.candidate[names]]
    if not len(names):
        return known
    tracks = tracks_of(views, names)
    poses = [pose_arrays(view.pose) for view in views]
    R, t = np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])
    first = tracks.visible.argmax(0)
    pixel = tracks.pixels[first, np.arange(len(names))]
    ray = (pixel - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    x_cam = np.concatenate([ray, np.ones((len(ray), 1))], 1) * t[first, 2:]
    start = Structure(R, t, np.einsum("nji,nj->ni", R[first], x_cam - t[first]))
    scale = max(1.0, views[-1].observation.window.side / 200)
    found = adjust(tracks, camera.K, start, fixed=len(views), scale=scale, iterations=8)
    known_residual = np.isfinite(found.residual)
    total = np.where(known_residual, found.residual, 0.0).sum(0)
    # A point that ends behind every camera has no residual, and fits nothing.
    residual = np.divide(
        total / scale, known_residual.sum(0), out=np.full(len(names), np.inf), where=known_residual.any(0)
    )
    motion = np.nanmax(np.linalg.norm(tracks.pixels - pixel, axis=2), 0) / scale
    # A point that stays while the object would have carried it along is none of it.
    carried = np.linalg.norm(
        project_camera_points(transform_to_camera(R, t, start.points), camera.K) - pixel, axis=2
    )
    carried = np.nanmax(np.where(tracks.visible, carried, np.nan), 0) / scale
    stays = (carried > _MOVED) & (motion < _STAYS * carried)
    near = np.linalg.norm(found.points - known.vertices.mean(0).cpu().numpy(), axis=1) < 1.6 * known.radius
    enough = tracks.visible.sum(0) >= _VIEWS
    accepted = enough & (residual < _FITS) & (motion > _MOVED) & near & ~stays
    rejected = stays | (enough & ((residual > _FAILS) | ~near) & (motion > _MOVED))
    rejected |= (tracks.visible.sum(0) >= 2 * _VIEWS) & ~accepted
    told = enough & (motion > _MOVED)
    beside = known.beside + _by_sector(views, first, pixel, told, residual < _FITS)
    around = np.zeros_like(accepted)
    if still(beside):
        # They tell the pose as well as the object's own points do, but nothing of its shape or mask.
        around, accepted = told & (residual < _FITS), np.zeros_like(accepted)
        rejected = (told | (tracks.visible.sum(0) >= 2 * _VIEWS)) & ~around
    landmarks, candidate = known.landmarks.copy(), known.candidate.copy()
    placed = accepted | around
    landmarks[names[placed]] = found.points[placed]
    candidate[names[accepted]] = False
    dropped = names[rejected & ~accepted]
    keyframes = tuple(
        replace(view, points=view.points.only(~np.isin(view.points.landmark, dropped)))
        for view in known.keyframes
    )
    return replace(known, landmarks=landmarks, candidate=candidate, keyframes=keyframes, beside=beside)


def still(beside: NDArray[np.int64]) -> bool:
    """Whether what is all around the object moves as it does: it stands still, and the camera moves.

    A mask that is too small has points of the object beside it on some sides, and so has one beside a hand.

    Args:
        beside: ``(S, 2)`` candidates in each sector around the object that could be told, and that fit its motion.
    """
    told, fit = beside.T
    tells = told >= _FEWEST
    if tells.sum() < _FEWEST_SECTORS:
        return False
    return bool((fit[tells] > _STILL * told[tells]).mean() > _STILL)


def _by_sector(
    views: list[View],
    first: NDArray[np.intp],
    pixel: NDArray[np.float64],
    told: NDArray[np.bool_],
    fits: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """``(S, 2)`` candidates in each direction from the middle of the mask, that can be told and that fit."""
    counts = np.zeros((_SECTORS, 2), np.int64)
    for number in np.unique(first[told]):
        mask = views[number].mask
        if mask is None or not mask.any():
            continue
        chosen = told & (first == number)
        x, y = (pixel[chosen] - np.argwhere(mask)[:, ::-1].mean(0)).T
        sector = ((np.arctan2(y, x) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
        np.add.at(counts, (sector, 0), 1)
        np.add.at(counts, (sector[fits[chosen]], 1), 1)
    return counts
