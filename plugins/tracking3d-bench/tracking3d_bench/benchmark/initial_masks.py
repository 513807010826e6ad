"""The masks that a variant asks for, as a folder that the tracker ``precomputed`` reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.results.files import write_mask, writing
from tracking3d.video.image_file import read_image
from tracking3d_bench.benchmark.variant import DEGRADED, HAND, NOISE, degraded_iou, noise_pixels
from tracking3d_bench.datasets.truth import MaskReference, Truth
from tracking3d_bench.synthesis.mask_degradation import degrade_to_iou
from tracking3d_bench.synthesis.mask_noise import noisy_boundaries, with_hand

SEED = 0


def masks_for(source: str, truth: Truth, folder: Path) -> Path:
    """The folder of masks for one sequence, made in ``folder`` if it is not there already.

    Trackers see what can be seen: all but ``initial`` masks are made from those of the visible part if it is known.
    What of the object is hidden then is marked as an occluder in those of ``truth``.

    Args:
        source: ``truth``, ``initial``, ``degraded:IOU``, ``noise:PIXELS``, ``hand``, or a folder with a folder of
            masks for every sequence.
        truth: The sequence.
        folder: Folder for the masks.

    Raises:
        InputError: If the sequence has no such masks.
    """
    if source == "truth":
        _write_masks(truth, _read_references(truth), folder)
        for n in truth.masks.keys() & truth.visible_masks.keys():
            visible = truth.visible_masks[n].read()
            if visible.any() and (hidden := truth.masks[n].read() & ~visible).any():
                write_mask(folder / f"{truth.names[n]}.png", visible, hidden)
        return folder
    if source == "initial":
        if not truth.initial_masks:
            raise InputError(f"{truth.name} comes with no initial masks; choose other --masks.")
        return _write_masks(truth, truth.initial_masks, folder)
    if source.startswith((DEGRADED, NOISE)) or source == HAND:
        return _rough(truth, source, folder)
    given = Path(source) / truth.name
    if not given.is_dir():
        raise InputError(f"{source} has no folder {truth.name} with the masks of that sequence.")
    return given


def _read_references(truth: Truth) -> Mapping[int, MaskReference]:
    masks = {**truth.masks, **truth.visible_masks}
    if not masks:
        raise InputError(f"{truth.name} has no true masks to start from; choose other --masks.")
    return masks


def _rough(truth: Truth, source: str, folder: Path) -> Path:
    masks = _read_references(truth)
    if len(masks) < len(truth.frames):
        raise InputError(
            f"{truth.name} has not a true mask in every frame: there is nothing to degrade there."
        )
    true = np.stack([masks[n].read() for n in range(len(truth.frames))])
    if source == HAND:
        rough = with_hand(true, SEED)
    elif source.startswith(NOISE):
        rough = noisy_boundaries(true, noise_pixels(source), SEED)
    else:
        images = np.stack([read_image(path) for path in truth.frames])
        rough = degrade_to_iou(true, images, degraded_iou(source), SEED)
    return _write(truth, {n: mask for n, mask in enumerate(rough) if mask.any()}, folder)


def _write_masks(truth: Truth, masks: Mapping[int, MaskReference], folder: Path) -> Path:
    return _write(truth, {n: reference.read() for n, reference in masks.items()}, folder)


def _write(truth: Truth, masks: Mapping[int, NDArray[np.bool_]], folder: Path) -> Path:
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for n, mask in masks.items():
        write_mask(folder / f"{truth.names[n]}.png", mask)
    return folder
