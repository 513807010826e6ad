"""The texture at the resolution of the video, from the sharpest and most frontal views.

Every view says what it shows of every texel. The views' exposures are brought to one level, and each texel takes the
mean of what they show, weighted so steeply by how frontally and how sharply a view shows it that one or two decide:
a mean of many would blur by what poses and shape are off. A view whose colour is far from the others' has little say
there: a highlight, a hand, something in front. Fine details that are lost all the same are restored at the end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.meshing import unwrap
from tracking3d.reconstruction.seen_regions import seen_vertices, select_seen_texels, spread_colours
from tracking3d.rendering import TexelMap, render, seen_texels
from tracking3d.rendering.backend import give_threads, threads_kept
from tracking3d.rendering.backprojection import SeenTexels
from tracking3d.runtime.concurrency import OrderedExecutor
from tracking3d.runtime.progress import report_each, report_progress
from tracking3d.scene.surface import camera_tensors, image_tensor
from tracking3d.scene.view import ObjectView

_SMALLEST = 64
_STEEPNESS = 3
"""Power of the weights, which are the squared cosine of the viewing angle already."""
_ROWS_AT_ONCE = 64  # of a texture, so that what is computed with them is small
_COARSE = 4  # times fewer texels along a side for exposures and votes
_EXPOSURE = 1.25  # factor up to which a view may be brighter or darker than the others
_VOTED_DOWN = 0.12  # difference of colours, in [0, 1], at which a view loses most of its say

FloatArray = NDArray[np.float32]
Seen = tuple[NDArray[np.int64], FloatArray, FloatArray]
"""The texels ``(N,)`` that a view shows, their colours ``(3, N)`` in [0, 1], and how well each is seen ``(N,)``."""


def bake_texture(
    model: ObjectModel, views: Sequence[ObjectView], largest: int = 2048, details: bool = True
) -> ObjectModel:
    """The model with a texture at the views' resolution; the same if no view shows it.

    Args:
        model: With shape and texture coordinates; its features stay.
        views: Frames with poses of this model.
        largest: Most texels along a side.
        details: Whether fine details are restored, see `restore_details`.

    Returns:
        The same surface. `ObjectModel.texture_weight` is 0 where no view shows it; there the texture continues its
        surroundings. Texels that are not on the surface continue it in both, so that neither a colour nor a 0 of theirs
        gets into what is interpolated at the edge of a chart.
    """
    if not views:
        return model
    with threads_kept():
        give_threads({"backend": "numba", "threads": 1})
        return _paint_texture(model, views, texture_size(views, largest), details)


def _paint_texture(model: ObjectModel, views: Sequence[ObjectView], size: int, details: bool) -> ObjectModel:
    report_progress("texture", 0, len(views))
    gains, coarse = _level_exposure(model, views, max(size // _COARSE, 64))
    expected = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_LINEAR).reshape(-1, 3)
    texels = TexelMap.of(torch.from_numpy(model.face_uvs).float(), size)
    total, weight = np.zeros((size * size, 3), np.float32), np.zeros(size * size, np.float32)
    sharpest = max(view.sharpness for view in views) or 1.0
    for view, gain in report_each("texture", list(zip(views, gains, strict=True))):
        add_view(total, weight, _seen(model, texels, view), gain, expected, view.sharpness / sharpest)
    if not weight.any():
        return model
    texel, face, barycentric = (part.numpy() for part in (texels.texel, texels.face, texels.barycentric))
    del expected  # a large texture takes 50 MB
    np.divide(total, np.maximum(weight, 1e-20)[:, None], out=total)
    shown = weight[texel] > 0
    surface = model.vertices, model.faces, face
    total[texel[~shown]] = spread_colours(*surface, barycentric, total[texel], shown)
    seen = select_seen_texels(*surface, shown)
    weight[texel] = np.where(seen, np.maximum(weight[texel], weight[weight > 0].min()), 0)
    if not seen.any():
        return model
    on_surface = np.zeros(size * size, bool)
    on_surface[texel] = True
    texture = fill_holes(total.reshape(size, size, 3), on_surface.reshape(size, size))
    del total
    if details:
        planes = np.ascontiguousarray(texture.transpose(2, 0, 1))
        del texture  # a large one takes 50 MB
        texture = restore_details(model, planes, texels, views, gains).transpose(1, 2, 0)
    np.clip(np.round(np.multiply(texture, 255, out=texture), out=texture), 0, 255, out=texture)
    return replace(
        model,
        texture=np.ascontiguousarray(texture, np.uint8),
        texture_weight=continue_charts(weight.reshape(size, size), texel),
    )


def add_view(
    total: FloatArray,
    weight: FloatArray,
    seen: Seen,
    gain: FloatArray,
    expected: FloatArray,
    sharpness: float,
) -> None:
    """Add what a view says to sums over all views.

    Args:
        total: ``(T * T, 3)`` weighted sum of colours, and ``weight`` ``(T * T,)`` of the weights; changed.
        weight: See ``total``.
        seen: What the view shows.
        gain: ``(3,)`` factors for its colours.
        expected: ``(T * T, 3)`` colours that all views together give.
        sharpness: Sharpness of the view, relative to the sharpest.
    """
    from tracking3d.reconstruction.kernels import texturing

    texturing.add_view(total, weight, seen, gain, expected, sharpness, _VOTED_DOWN, _STEEPNESS)


def texture_size(views: Sequence[ObjectView], largest: int) -> int:
    """Texels along a side, a power of two: about one a pixel of the views, where the atlas goes once around."""
    boxes = (cv2.boundingRect(view.mask.astype(np.uint8)) for view in views)
    wanted = math.pi * max(max(width, height) for _, _, width, height in boxes)
    return min(max(1 << round(math.log2(wanted)), _SMALLEST), largest)


def fill_holes(texture: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """``(T, T, 3)`` where texels that are not known continue those that are, smoothly and around the seam in u."""
    if known.all() or not known.any():
        return texture
    height, width = known.shape
    if min(height, width) <= 2:
        mean = texture[known].mean(0)
        return np.where(known[..., None], texture, mean).astype(np.float32)
    # Mean over blocks of what is known, filled itself, and back: push and pull.
    half = (math.ceil(width / 2), math.ceil(height / 2))
    share = cv2.resize(known.astype(np.float32), half, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(texture * known[..., None], half, interpolation=cv2.INTER_AREA)
    coarse = fill_holes(mean / np.maximum(share, 1e-6)[..., None], share > 0)
    wrapped = np.concatenate([coarse[:, -1:], coarse, coarse[:, :1]], 1)
    columns = (np.arange(width, dtype=np.float32) + 0.5) * half[0] / width - 0.5 + 1
    rows = (np.arange(height, dtype=np.float32) + 0.5) * half[1] / height - 0.5
    filled = texture.copy()
    for first in range(0, height, _ROWS_AT_ONCE):
        strip = slice(first, first + _ROWS_AT_ONCE)
        x, y = np.meshgrid(columns, rows[strip])
        beyond = cv2.remap(wrapped, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        np.copyto(filled[strip], beyond, where=~known[strip, :, None])
    return filled


def continue_charts(values: FloatArray, texel: NDArray[np.int64]) -> FloatArray:
    """``(T, T)`` where texels off the surface have the value of the nearest one on it.

    Args:
        values: ``(T, T)``.
        texel: ``(N,)`` flat indices of the texels on the surface, at least one.
    """
    beyond = np.ones(values.shape, np.uint8)
    beyond.ravel()[texel] = 0
    _, labels = cv2.distanceTransformWithLabels(
        beyond, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_of_label = np.zeros(labels.max() + 1, np.float32)
    value_of_label[labels.ravel()[texel]] = values.ravel()[texel]
    return np.asarray(value_of_label[labels])


def _level_exposure(
    model: ObjectModel, views: Sequence[ObjectView], size: int
) -> tuple[list[FloatArray], FloatArray]:
    """Factors ``(3,)`` that bring each view's colours to one level, and the texture ``(T, T, 3)`` that they give."""
    texels = TexelMap.of(torch.from_numpy(model.face_uvs).float(), size)
    seen = [
        (texel, colours.T.copy(), say)
        for texel, colours, say in (_seen(model, texels, view) for view in views)
    ]

    def mean(gains: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        total, weight = np.zeros((size * size, 3), np.float32), np.zeros(size * size, np.float32)
        for (texel, colours, say), gain in zip(seen, gains, strict=True):
            total[texel] += say[:, None] * gain * colours
            weight[texel] += say
        return _divide_safely(total, weight), weight

    gains = [np.ones(3, np.float32) for _ in views]
    level, _ = mean(gains)
    for n, (texel, colours, say) in enumerate(seen):
        if len(texel):
            ours = (say[:, None] * colours**2).sum(0)
            both = (say[:, None] * colours * level[texel]).sum(0)
            gains[n] = np.clip(both / np.maximum(ours, 1e-12), 1 / _EXPOSURE, _EXPOSURE).astype(np.float32)
    level, weight = mean(gains)
    return gains, fill_holes(level.reshape(size, size, 3), (weight > 0).reshape(size, size))


def _divide_safely(total: FloatArray, weight: FloatArray) -> FloatArray:
    return np.asarray(total / np.maximum(weight, 1e-20)[:, None], np.float32)


def _seen(model: ObjectModel, texels: TexelMap, view: ObjectView) -> Seen:
    R, t, K = camera_tensors(view)
    vertices, faces = torch.from_numpy(model.vertices).float(), torch.from_numpy(model.faces)
    valid = torch.from_numpy(view.interior)
    seen = seen_texels(image_tensor(view), valid, vertices, faces, texels, R[0], t[0], K[0])
    return seen.texel.numpy(), seen.values.numpy(), seen.weight.numpy()


_BLANK = 64  # texels along a side of a texture that a better one replaces


def replace_shape(
    model: ObjectModel,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    views: Sequence[ObjectView],
) -> ObjectModel:
    """The object with another surface at the same place.

    Args:
        model: As it was.
        vertices: ``(V, 3)``; faces: ``(F, 3)``.
        views: The frames that say what of it was seen.

    Returns:
        It, in its mean colour until it gets a texture.
    """
    face_uvs = unwrap(vertices, faces)
    mean = model.texture.reshape(-1, 3).mean(0)
    return replace(
        model,
        vertices=vertices,
        faces=faces,
        face_uvs=face_uvs,
        features=_transfer_texture(model, model.features, vertices, faces, face_uvs),
        texture=np.broadcast_to(mean, (_BLANK, _BLANK, 3)).astype(model.texture.dtype),
        texture_weight=np.zeros((_BLANK, _BLANK), np.float32),
        seen=seen_vertices(vertices, faces, views),
    )


def _transfer_texture(
    model: ObjectModel,
    values: NDArray,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    face_uvs: NDArray[np.float64],
) -> NDArray:
    """A texture ``(T, T, C)`` of the new surface from one of the old: from the nearest texel."""
    size = len(values)
    old_texel, old_points = _texel_points(model.vertices, model.faces, model.face_uvs, size)
    texel, points = _texel_points(vertices, faces, face_uvs, size)
    _, nearest = cKDTree(old_points).query(points, eps=0.2)
    flat = values.reshape(-1, values.shape[2])
    carried = np.broadcast_to(flat.mean(0), (size * size, flat.shape[1])).astype(values.dtype)
    carried[texel] = flat[old_texel[nearest]]
    return carried.reshape(size, size, -1)


def _texel_points(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], face_uvs: NDArray[np.float64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    texels = TexelMap.of(torch.from_numpy(face_uvs).float(), size)
    corners = vertices[faces[texels.face.numpy()]]
    return texels.texel.numpy(), (corners * texels.barycentric.numpy()[..., None]).sum(1)


# Fine details of a texture, which the views show and their mean has lost.
#
# Colours are interpolated twice, from a view into the texture and from the texture into an image, and views do not lie
# on each other exactly: a rendered view is more blurred than the filmed one. The difference between each view and what
# the texture predicts of it is therefore taken back into the texture, as in super-resolution (Irani and Peleg,
# "Improving resolution by image registration", 1991). Slow differences are left out: they are light, not texture.

_LIGHT_SIGMA = 10.0
_AT_A_TIME = 2  # views
_OTHER_COLOUR = 0.12
"""Difference in [0, 1] at which a pixel counts half: a highlight, or something in front."""


def restore_details(
    model: ObjectModel,
    texture: FloatArray,
    texels: TexelMap,
    views: Sequence[ObjectView],
    gains: Sequence[FloatArray],
) -> FloatArray:
    """A texture with the details that its views show and it does not.

    Args:
        model: The surface, with its texture coordinates.
        texture: ``(3, T, T)`` colours in [0, 1]; changed.
        texels: Its texels on the surface.
        views: Frames with poses of this model.
        gains: ``(3,)`` factors for the colours of each view.

    Returns:
        ``(3, T, T)`` in [0, 1], the same array.
    """
    surface = torch.from_numpy(model.vertices).float(), torch.from_numpy(model.faces)
    face_uvs, colours = torch.from_numpy(model.face_uvs).float(), torch.from_numpy(texture)
    total, weight = np.zeros((3, texture[0].size), np.float32), np.zeros(texture[0].size, np.float32)
    sharpest = max((view.sharpness for view in views), default=0.0) or 1.0
    jobs = OrderedExecutor(min(cv2.getNumThreads(), _AT_A_TIME))
    for view, gain in zip(views, gains, strict=True):
        for done in jobs.do(partial(_find_missing_details, surface, face_uvs, colours, texels, view, gain)):
            _add(total, weight, done, sharpest)
    for done in jobs.rest():
        _add(total, weight, done, sharpest)
    for channel, added in zip(texture, total, strict=True):
        channel += (added / np.maximum(weight, 1e-12)).reshape(channel.shape)
        np.clip(channel, 0, 1, out=channel)
    return texture


def _find_missing_details(
    surface: tuple[Tensor, Tensor],
    face_uvs: Tensor,
    colours: Tensor,
    texels: TexelMap,
    view: ObjectView,
    gain: FloatArray,
) -> tuple[ObjectView, SeenTexels]:
    """The difference between what a view shows of its texels and what the texture predicts."""
    R, t, K = camera_tensors(view)
    drawn = render(*surface, face_uvs, colours, R, t, K, view.window.shape)
    predicted = drawn.image()[0].permute(1, 2, 0).numpy()
    valid = view.interior * (drawn.face_index[0].numpy() >= 0)
    difference, valid = _remove_light(view.image * (gain / 255) - predicted, valid)
    layers = torch.from_numpy(difference).permute(2, 0, 1)
    return view, seen_texels(layers, torch.from_numpy(valid), *surface, texels, R[0], t[0], K[0])


def _add(total: FloatArray, weight: FloatArray, done: tuple[ObjectView, SeenTexels], sharpest: float) -> None:
    """Add what a view shows to the weighted sums ``(3, N)`` and the sum of weights ``(N,)``."""
    view, seen = done
    texel, share = seen.texel.numpy(), seen.weight.numpy() * np.float32(view.sharpness / sharpest)
    for channel, values in zip(total, seen.values.numpy(), strict=True):
        channel[texel] += share * values
    weight[texel] += share


def _remove_light(difference: NDArray[np.floating], valid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A difference ``(S, S, 3)`` without what changes slowly, and how far each of its pixels is the texture's."""
    inside = (valid > 0).astype(np.float32)
    difference = (difference * inside[..., None]).astype(np.float32)
    slow = cv2.GaussianBlur(difference, (0, 0), _LIGHT_SIGMA)
    slow /= np.maximum(cv2.GaussianBlur(inside, (0, 0), _LIGHT_SIGMA), 1e-3)[..., None]
    fast = (difference - slow) * inside[..., None]
    red, green, blue = cv2.split(np.abs(fast))  # a maximum along the short last axis takes ten times as long
    agrees = 1 / (1 + np.square(cv2.max(cv2.max(red, green), blue) / _OTHER_COLOUR))
    return fast, (valid * agrees).astype(np.float32)
