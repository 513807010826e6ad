"""Whether a new shape explains frames better that were kept out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.photometric_poses import coloured_surface, refine_views
from tracking3d.rendering import render
from tracking3d.scene.surface import camera_tensors
from tracking3d.scene.view import ObjectView

EVERY = 8
"""One in this many reliable frames is kept out of the reconstruction."""
_WORSE_OUTLINE = 0.01
"""IoU that may be lost if colours gain."""


MOST_LEFT_OUT = 32
"""Frames that are asked."""


def is_held_out(place: int) -> bool:
    """Whether a reliable frame, counted from 0, is kept out of the reconstruction."""
    return place % EVERY == EVERY // 2


@dataclass(frozen=True)
class HeldOutScore:
    """How well a shape explains frames, in the mean."""

    iou: float  # IoU of silhouette and mask
    # mean difference of colours in [0, 1] where both the mask and the surface are; what the surface does not
    # cover counts in the IoU
    colour: float

    def better_than(self, other: HeldOutScore) -> bool:
        """Whether it gains more than it loses, and no outline to speak of."""
        gain = self.iou - other.iou + other.colour - self.colour
        return gain > 0 and self.iou >= other.iou - _WORSE_OUTLINE


def score_held_out(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    views: Sequence[ObjectView],
    left_out: Sequence[ObjectView],
) -> HeldOutScore:
    """How well a shape, coloured by ``views``, explains those left out, whose poses alone are fitted to it.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        views: The frames that the shape was made from.
        left_out: The others.
    """
    surface = coloured_surface(vertices, faces, views)
    overlaps, differences = [], []
    for view in refine_views(surface, left_out):
        drawn = render(
            surface.vertices, surface.faces, surface.face_uvs, surface.texture,
            *camera_tensors(view), view.window.shape,
        )  # fmt: skip
        covered, mask = drawn.face_index[0].numpy() >= 0, view.mask
        either = (covered | mask) & view.in_frame
        overlaps.append((covered & mask).sum() / max(either.sum(), 1))
        colours = drawn.image()[0].permute(1, 2, 0).numpy()
        apart = np.abs(colours - view.image / 255.0).mean(2)
        both = covered & mask
        differences.append(float(apart[both].mean()) if both.any() else 1.0)
    return HeldOutScore(float(np.mean(overlaps)), float(np.mean(differences)))


_UNCOVERED = 0.5
"""Colour that is counted where the mask is and the model is not."""
_MOST_DECIBELS = 60.0


@dataclass(frozen=True)
class HeldOutScores:
    """Mean scores of frames that were left out; within the mask, as far as colours there are surely the object's."""

    frames: int  # how many
    psnr: float  # peak signal-to-noise ratio, decibels
    ssim: float  # structural similarity (Wang et al., 2004)
    covered: float  # share of the mask that the model covers


def held_out_scores(
    model: ObjectModel, used: Sequence[ObjectView], left_out: Sequence[tuple[ObjectView, ObjectView]]
) -> HeldOutScores:
    """Render the model as the frames that were left out should show it, and compare.

    Args:
        model: With a texture that those frames gave nothing to.
        used: The frames that it was made from, for the colours that poses are fitted by.
        left_out: The others, at least one, as shapes and as textures are made from them; their poses alone are fitted.
    """
    surface = coloured_surface(model.vertices, model.faces, used)
    fitted = refine_views(surface, [shape for shape, _ in left_out])
    each = [
        _compare(model, replace(view, T_cam_obj=shape.T_cam_obj))
        for shape, (_, view) in zip(fitted, left_out, strict=True)
    ]
    psnr, ssim, covered = np.mean(each, axis=0)
    return HeldOutScores(len(each), float(psnr), float(ssim), float(covered))


def _compare(model: ObjectModel, view: ObjectView) -> tuple[float, float, float]:
    from kornia.metrics import psnr
    from skimage.metrics import structural_similarity

    drawn = render(
        torch.from_numpy(model.vertices).float(),
        torch.from_numpy(model.faces),
        torch.from_numpy(model.face_uvs).float(),
        torch.from_numpy(model.texture).permute(2, 0, 1).float() / 255,
        *camera_tensors(view),
        view.window.shape,
    )
    picture, inside = view.image / 255.0, view.interior > 0
    covered = drawn.face_index[0].numpy() >= 0
    predicted = np.where(covered[..., None], drawn.image()[0].permute(1, 2, 0).numpy(), _UNCOVERED)
    predicted = np.where(inside[..., None], predicted, picture)  # outside the mask nothing is predicted
    ratio = psnr(torch.from_numpy(predicted[inside]), torch.from_numpy(picture[inside]), 1.0)
    _, similarity = structural_similarity(
        picture, predicted, channel_axis=2, full=True, data_range=1.0, gaussian_weights=True
    )
    return (
        min(float(ratio), _MOST_DECIBELS),  # it is infinite if the two are the same
        float(similarity[inside].mean()),
        float(covered[inside].mean()),
    )
