"""The mask that a frame is answered with: rendered, initial, or what both agree on."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.estimate import MaskSource
from tracking3d.estimation.online.belief import View
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import Surface, render, sample_texture
from tracking3d.rendering.texture_losses import cauchy

_ALIKE = 0.85  # IoU of two masks that differ along their outlines only
_SUPPORTED, _UNSUPPORTED = 0.6, 0.3  # shares of what is rendered beside the mask that settle who is right
_FEW = 0.02  # share of the silhouette beside the mask that is an outline's width
_AS_GOOD, _NOISE = (
    2.0,
    0.2,
)  # how much worse than inside the mask a pixel beside it may fit, and how bad is fine
_SHARE = 0.6  # of the rendered outline in the mean of both: where they are far apart it decides
_REACH = 0.06  # of the root of the area: how far an outline pulls


def answer_mask(
    rendered: NDArray[np.bool_],
    initial: NDArray[np.bool_] | None,
    support: float,
) -> tuple[NDArray[np.bool_], MaskSource]:
    """The better supported of two masks ``(H, W)``, or the mean of their outlines where they are alike.

    Args:
        rendered: The silhouette at the frame's pose.
        initial: The mask tracker's, or None.
        support: How far the pixels support what is rendered beside the initial mask, see `support_beside`.

    Returns:
        The mask, and where it comes from.
    """
    if initial is None:
        return rendered, MaskSource.RENDERED
    overlap = float((rendered & initial).sum()) / max(float((rendered | initial).sum()), 1.0)
    if support < _UNSUPPORTED:
        return initial, MaskSource.INITIAL
    if support >= _SUPPORTED and overlap < _ALIKE:
        return rendered, MaskSource.RENDERED
    return _mean_outline(rendered, initial), MaskSource.MEAN


@torch.no_grad()
def support_beside(surface: Surface, view: View, pose: Pose, scale: float) -> float:
    """Share of the silhouette beside the initial mask that looks like the object, in [0, 1].

    A pixel does whose texture is known and fits not much worse than the pixels inside the mask do. Little is known
    of the texture where no mask ever was.

    Args:
        surface: The object.
        view: The frame.
        pose: Its pose.
        scale: Of the Cauchy loss.
    """
    observation = view.observation
    size = (observation.window.size, observation.window.size)
    drawn = render(
        surface.vertices, surface.faces, surface.face_uvs, surface.texture, pose.R[None], pose.translation[None],
        observation.K[None], size, backend=surface.renderer,
    )  # fmt: skip
    inside = observation.valid.reshape(-1)[drawn.pixels] > 0.5
    masked = observation.mask.reshape(-1)[drawn.pixels] > 0.5
    beside = inside & ~masked
    if float(beside.sum()) < _FEW * max(float(inside.sum()), 1.0) or not bool((inside & masked).any()):
        return 1.0
    seen = sample_texture(surface.seen, drawn.uv)[:, 0] > 0.5
    shown = observation.features.permute(1, 2, 0).reshape(-1, observation.features.shape[0])[drawn.pixels]
    loss = cauchy(drawn.features, shown, scale).mean(1)
    limit = _AS_GOOD * float(loss[inside & masked].median()) + _NOISE
    return float((seen & (loss < limit))[beside].float().mean())


def _mean_outline(rendered: NDArray[np.bool_], initial: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where the weighted mean of both signed distances, each cut off at `_REACH`, is inside."""
    reach = _REACH * float(np.sqrt(initial.sum()))

    def distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        inside = mask.astype(np.uint8)
        outward = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_5)
        inward = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5)
        return np.asarray(np.clip(outward - inward, -reach, reach), dtype=np.float32)

    mean = _SHARE * distance(rendered) + (1 - _SHARE) * distance(initial)
    return np.asarray(mean < 0)
