"""Fine details of a texture, which the views show and their mean has lost.

Colours are interpolated twice, from a view into the texture and from the texture into an image, and views do not lie
on each other exactly: a rendered view is more blurred than the filmed one. The difference between each view and what
the texture predicts of it is therefore taken back into the texture, as in super-resolution (Irani and Peleg, "Improving
resolution by image registration", 1991). Slow differences are left out: they are light, not texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.views import TextureView
from tracking3d.rendering import TexelMap, render, seen_texels
from tracking3d.rendering.backprojection import SeenTexels
from tracking3d.runtime.concurrency import OrderedExecutor

FloatArray = NDArray[np.float32]

_LIGHT_SIGMA = 10.0
"""Pixels over which a difference is light."""
_AT_A_TIME = 2  # views
_OTHER_COLOUR = 0.12
"""Difference in [0, 1] at which a pixel counts half: a highlight, or something in front."""


def restore_details(
    model: ObjectModel,
    texture: FloatArray,
    texels: TexelMap,
    views: Sequence[TextureView],
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
    view: TextureView,
    gain: FloatArray,
) -> tuple[TextureView, SeenTexels]:
    """The difference between what a view shows of its texels and what the texture predicts."""
    R = torch.from_numpy(view.T_cam_obj[:3, :3]).float()
    t, K = torch.from_numpy(view.T_cam_obj[:3, 3]).float(), torch.from_numpy(view.K).float()
    size = view.valid.shape[0], view.valid.shape[1]
    drawn = render(*surface, face_uvs, colours, R[None], t[None], K[None], size)
    predicted = drawn.image()[0].permute(1, 2, 0).numpy()
    valid = view.valid * (drawn.face_index[0].numpy() >= 0)
    difference, valid = _remove_light(view.image * (gain / 255) - predicted, valid)
    layers = torch.from_numpy(difference).permute(2, 0, 1)
    return view, seen_texels(layers, torch.from_numpy(valid), *surface, texels, R, t, K)


def _add(
    total: FloatArray, weight: FloatArray, done: tuple[TextureView, SeenTexels], sharpest: float
) -> None:
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
    agrees = 1 / (1 + np.square(np.abs(fast).max(2) / _OTHER_COLOUR))
    return fast, (valid * agrees).astype(np.float32)
