"""Scores of a model against frames of its run that it was not made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.held_out_test import MOST_LEFT_OUT, is_held_out
from tracking3d.reconstruction.photometric_poses import coloured_surface, refine_views
from tracking3d.reconstruction.rebuild import check_packages
from tracking3d.reconstruction.run_views import reliable_frames, views_of_frame
from tracking3d.reconstruction.shape import MOST
from tracking3d.reconstruction.texturing import bake_texture
from tracking3d.reconstruction.views import keep_best_views, spread_by_rotation
from tracking3d.rendering import render
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.scene.surface import camera_tensors
from tracking3d.scene.view import ObjectView

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


_TEXTURE_VIEWS = 24


class NothingHeldOutError(InputError):
    """Too few frames of a run are reliable."""


def score_held_out_frames(folder: Path, source: str | None = None, largest: int = 2048) -> HeldOutScores:
    """How well the mesh of a run predicts frames that it was not made from.

    The frames that `rebuild_shape` keeps out are; the others give the mesh its texture again, and the poses alone of
    those kept out are fitted to it. Nothing is written. All frames have shaped the surface of an online map's mesh.

    Args:
        folder: The run folder.
        source: The video; None for the one that the run names.
        largest: Most texels along a side.

    Raises:
        InputError: If a package is missing, the run goes on, has no mesh, too few reliable frames, or the
            video is another one.
    """
    check_packages()
    run = RunReader(folder)
    model = load_model(run.mesh_folder)
    used: list[ObjectView] = []
    left_out: list[tuple[ObjectView, ObjectView]] = []
    views: tuple[ObjectView, ...] = ()
    count = 0
    for frame, record in reliable_frames(run, source):
        if (seen := views_of_frame(run, frame, record)) is None:
            continue
        if is_held_out(count):
            left_out.append(seen)
        else:
            used.append(seen[0])
            views = keep_best_views(views, seen[1], _TEXTURE_VIEWS)
        count += 1
        if len(used) > 2 * MOST:
            used = spread_by_rotation(used, 0.5, MOST)
        if len(left_out) > MOST_LEFT_OUT:
            left_out = left_out[::2]
    if not left_out:
        raise NothingHeldOutError(
            f"Only {count} frames of the run {folder} are reliable; none can be held out to test its model."
        )
    return held_out_scores(bake_texture(model, views, largest), used, left_out)
