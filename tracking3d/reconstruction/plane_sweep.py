"""Depth by matching patches between views along the motion that is known.

A surface that is about right says where to look. Around its depth, planes with its normal are tried at every pixel: the
patch is carried into the neighbouring views, and agrees with them as much as the brightness correlates there, gain and
offset left out. The mean over the views that agree best counts, since something may stand before the others. The depth
lies at the vertex of the parabola through the best score and its neighbours. It is accepted if the patch has
contrast, the score is high, and other views' depths say the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.geometry.mesh import vertex_normals
from tracking3d.reconstruction.meshing import FloatArray
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.renderer import project
from tracking3d.rendering.visibility import rasterize
from tracking3d.runtime.progress import report_each
from tracking3d.scene.surface import camera_tensors
from tracking3d.scene.view import ObjectView

NEIGHBOURS, AGREEING = 6, 3
"""Views that a patch is looked for in, and those of them that count."""
BASELINE = (4.0, 25.0, 12.0)
"""Degrees between the directions of two views that are compared: least, most, and best."""
_WIDEST = 40.0  # degrees, most between photos in wide steps (measured: a mug and others in steps of 30)
_DEEPEST = 7.5  # reaches behind the surface at hand that are searched in them (chosen: across a mug)
RADIUS = 3
"""Radius of a patch, pixels."""
LEAST_CONTRAST = 3.0
"""Deviation of grey values from which on a patch tells something."""
LEAST_SCORE = 0.85
MOST_PIXELS = 5000
"""Pixels of a view whose depth is estimated."""
_STEEPEST = 0.2  # cosine of the viewing angle below which a surface is too slanted to be compared


@dataclass(frozen=True, eq=False)
class DepthMap:
    """What one view says of depth."""

    view: ObjectView  # the view
    depth: FloatArray  # (S, S) float32 z in camera coordinates, NaN where nothing is known
    score: FloatArray  # (S, S) float32 correlation there
    stride: int = 1  # spacing, in pixels, of the grid at which depths are estimated; at most


@dataclass(frozen=True, eq=False)
class Guide:
    """The surface that says where to look: ``(V, 3)`` vertices in object coordinates and ``(F, 3)`` faces."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]

    def visible_to(self, view: ObjectView) -> tuple[FloatArray, FloatArray]:
        """Depth ``(S, S)``, infinite outside the surface, and unit normals ``(S, S, 3)`` in camera coordinates."""
        R, t, K = camera_tensors(view)
        vertices, faces = torch.from_numpy(self.vertices).float(), torch.from_numpy(self.faces)
        screen, z = project(vertices, R, t, K)
        size = view.window.shape
        drawn = rasterize(screen, z, faces, size)
        turned = (vertex_normals(vertices, faces) @ R[0].T)[faces]
        normals = np.zeros((*size, 3), np.float32)
        normals.reshape(-1, 3)[drawn.pixels.numpy()] = interpolate(
            screen, z, faces, turned, drawn.face_index
        ).numpy()
        return drawn.depth[0].numpy(), normals


def depth_maps(
    views: Sequence[ObjectView],
    references: Sequence[ObjectView],
    guide: Guide,
    reach: float,
    steps: int,
    *,
    wide: bool = False,
) -> list[DepthMap]:
    """The depths that the references see, as far as others say the same.

    Args:
        views: All views that patches are looked for in.
        references: Those whose depths are wanted.
        guide: The surface around which to look.
        reach: How far from it, to either side.
        steps: Depths that are tried on either side.
        wide: The views are photos in wide steps: views further apart are compared, and where no depth is found, as
            inside a hollow thing whose mouth the surface closes, it is looked for all the way behind the surface.
    """
    grey = {view.index: _grey(view) for view in views}
    stride = _stride(references)
    maps = [
        _depth_map(view, neighbours, grey, guide, reach, steps, stride, wide)
        for view in report_each("matching depths", references)
        if len(neighbours := _neighbours(view, views, _WIDEST if wide else BASELINE[1])) >= 2
    ]
    return [_check_consistency(one, maps, reach / steps, stride, int(wide)) for one in maps]


def _stride(references: Sequence[ObjectView]) -> int:
    """Spacing of the pixels that are sampled: enough for the grid, and not all of a large view."""
    largest = max((int(view.mask.sum()) for view in references), default=0)
    return max(2, round(np.sqrt(largest / MOST_PIXELS)))


def _neighbours(view: ObjectView, views: Sequence[ObjectView], most: float) -> list[ObjectView]:
    least, _, best = BASELINE
    found = []
    for other in views:
        if other.index == view.index:
            continue
        relative = other.T_cam_obj[:3, :3] @ view.T_cam_obj[:3, :3].T
        angle = float(np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))))
        if least <= angle <= most:
            found.append((abs(np.log(angle / best)), other.index, other))
    found.sort(key=lambda one: one[:2])
    return [one[2] for one in found[:NEIGHBOURS]]


def _grey(view: ObjectView) -> FloatArray:
    return cv2.GaussianBlur(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 0.7)


def _depth_map(
    view: ObjectView,
    neighbours: Sequence[ObjectView],
    grey: dict[int, FloatArray],
    guide: Guide,
    reach: float,
    steps: int,
    stride: int,
    wide: bool,
) -> DepthMap:
    drawn, normals = guide.visible_to(view)
    side = len(drawn)
    rows, columns = np.mgrid[:side:stride, :side:stride]
    asked = np.isfinite(drawn[::stride, ::stride]) & view.mask[::stride, ::stride]
    pixels = np.stack([rows[asked], columns[asked]], 1).astype(np.int64)
    first = drawn[pixels[:, 0], pixels[:, 1]].astype(np.float64)
    normal = normals[pixels[:, 0], pixels[:, 1]].astype(np.float64)
    K_inverse: NDArray[np.float64] = np.asarray(np.linalg.inv(view.K), np.float64)
    rays = np.column_stack([pixels[:, 1], pixels[:, 0], np.ones(len(pixels))]) @ K_inverse.T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    facing = -(normal * rays).sum(1) / np.linalg.norm(rays, axis=1)
    # If the surface is too slanted, as if half turned towards the camera.
    towards = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    normal = np.where((facing > _STEEPEST)[:, None], normal, normal + towards)
    sweeps = [(normal, np.linspace(-reach, reach, 2 * steps + 1))]
    if wide:
        sweeps.append((towards, np.arange(steps // 2, _DEEPEST * steps) * reach / steps))
    T_cam_obj = view.T_cam_obj
    P = np.stack([other.K @ (other.T_cam_obj @ np.linalg.inv(T_cam_obj))[:3] for other in neighbours])
    others = np.stack([grey[other.index] for other in neighbours])
    depth, score = (np.full((side, side), fill, np.float32) for fill in (np.nan, -1.0))
    for facing_normal, offsets in sweeps:
        rest = np.isnan(depth[tuple(pixels.T)])
        scores, contrast = patch_scores(
            grey[view.index],
            view.mask.astype(np.float32),
            K_inverse,
            others,
            P,
            pixels[rest],
            first[rest],
            facing_normal[rest],
            offsets,
        )
        place, value = _peak(scores)
        kept = (contrast >= LEAST_CONTRAST) & (value >= LEAST_SCORE) & np.isfinite(place)
        at = tuple(pixels[rest][kept].T)
        depth[at] = (first[rest] + np.interp(place, np.arange(len(offsets)), offsets))[kept]
        score[at] = value[kept]
    return DepthMap(view, depth, score, stride)


def patch_scores(
    image: FloatArray,
    inside: FloatArray,
    K_inverse: NDArray[np.float64],
    others: FloatArray,
    P: NDArray[np.float64],
    pixels: NDArray[np.int64],
    depth: NDArray[np.float64],
    normal: NDArray[np.float64],
    offsets: NDArray[np.float64],
) -> tuple[FloatArray, FloatArray]:
    """How well patches agree with other views at each of D depths.

    Args:
        image: ``(S, S)`` grey values.
        inside: ``(S, S)`` above 0.5 on the object; other pixels have no say.
        K_inverse: ``(3, 3)`` of the view.
        others: ``(M, S, S)`` grey values of the other views.
        P: ``(M, 3, 4)`` from camera coordinates of the view to pixels of the others, times the depth.
        pixels: ``(N, 2)`` row and column of the patches' middles.
        depth: ``(N,)``; normal: ``(N, 3)``: the surface at hand, in camera coordinates.
        offsets: ``(D,)`` what is added to the depth.

    Returns:
        ``(N, D)`` mean correlation with the views that agree best, a view that does not see the patch counting -1,
        and ``(N,)`` the deviation of the patches' grey values, 0 if there is no patch.
    """
    agreeing = min(AGREEING, len(others))
    from tracking3d.reconstruction.kernels.plane_sweep import OtherViews, ReferenceView, SweptPatches, sweep

    scores = np.empty((len(pixels), len(offsets)), np.float32)
    contrast = np.empty(len(pixels), np.float32)
    sweep(
        ReferenceView(image, inside, np.ascontiguousarray(K_inverse)),
        OtherViews(others, np.ascontiguousarray(P)),
        SweptPatches(pixels, depth, normal, offsets),
        RADIUS,
        LEAST_CONTRAST,
        agreeing,
        scores,
        contrast,
    )
    return scores, contrast


def _peak(scores: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where each row of ``(N, D)`` has its peak, between the columns, NaN at the ends; and how high it is."""
    best = scores.argmax(1)
    last = scores.shape[1] - 1
    row, middle = np.arange(len(scores)), np.clip(best, 1, last - 1)
    before, here, after = (scores[row, middle + step] for step in (-1, 0, 1))
    bend = 2 * here - before - after
    place = middle + np.where(bend > 1e-6, (after - before) / np.maximum(2 * bend, 1e-6), 0.0)
    inner = (best > 0) & (best < last) & (before > -1) & (after > -1)
    return np.where(inner, place, np.nan).astype(np.float32), here


def _check_consistency(
    one: DepthMap, maps: Sequence[DepthMap], tolerance: float, stride: int, around: int
) -> DepthMap:
    """With those depths alone that at least one other map confirms, by one of the pixels ``around`` too."""
    view = one.view
    rows, columns = np.nonzero(np.isfinite(one.depth))
    z = one.depth[rows, columns].astype(np.float64)
    camera = np.column_stack([columns, rows, np.ones(len(rows))]) @ np.linalg.inv(view.K).T * z[:, None]
    points = (camera - view.T_cam_obj[:3, 3]) @ view.T_cam_obj[:3, :3]
    confirmed = np.zeros(len(points), int)
    for other in maps:
        if other is one or other.view.T_cam_obj[2, :3] @ view.T_cam_obj[2, :3] < 0.5:
            continue
        x, y, depth = other.view.P[:, :3] @ points.T + other.view.P[:, 3:]
        last = (len(one.depth) - 1) // stride
        column, row = (np.round(np.clip(value / depth / stride, 0, last)).astype(int) for value in (x, y))
        near = np.zeros(len(points), bool)
        for down, right in product(range(-around, around + 1), repeat=2):
            at = np.clip(row + down, 0, last) * stride, np.clip(column + right, 0, last) * stride
            near |= np.abs(other.depth[at] - depth) < 2 * tolerance
        confirmed += near
    kept = np.full_like(one.depth, np.nan)
    sure = confirmed >= 1
    kept[rows[sure], columns[sure]] = one.depth[rows[sure], columns[sure]]
    return DepthMap(view, kept, one.score, stride)
