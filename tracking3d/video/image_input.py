"""Conversion of the caller's images to RGB arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image as Pillow
from torch import Tensor

from tracking3d.config.explain import a_kind
from tracking3d.errors import InputError
from tracking3d.frames import Image
from tracking3d.video.image_file import read_image

WANTED = "(H, W, 3) arrays of uint8, RGB"
"""The input that messages ask for; the documentation names the other kinds."""


def validate_image(image: Any, position: int) -> Image:
    """An image as a new ``(H, W, 3)`` uint8 array; callers like to decode every frame into one buffer.

    Args:
        image: An ``(H, W, 3)`` uint8 array, RGB, or what numpy reads as one; a tensor, see `tensor_image`; a picture of
            Pillow, of whatever mode, as it is; or the path of an image file, which is turned upright.
        position: What number the frame has, for messages.

    Raises:
        InputError: If it is no image.
    """
    label = f"Frame {position}"
    if isinstance(image, str | Path):
        return read_image(Path(image).expanduser())
    if isinstance(image, Tensor):
        return tensor_image(image, label)
    try:
        if isinstance(image, Pillow.Image):
            image = image.convert("RGB")
        copy = np.array(np.asarray(image), order="C")
    except Exception as error:  # what a class makes of itself as an array can fail in any way
        raise InputError(f"{label} is {a_kind(image)}; give {WANTED}.") from error
    if copy.ndim == 0:
        raise InputError(f"{label} is {a_kind(image)}; give {WANTED}.")
    check_image(copy, label)
    return copy


def tensor_image(tensor: Tensor, label: str) -> Image:
    """A tensor of any device as a new array.

    Args:
        tensor: ``(3, H, W)`` or ``(H, W, 3)``; uint8, or of floats in [0, 1], which are rounded to 255ths.
        label: What messages call it.

    Raises:
        InputError: If it has another shape or type, or other values.
    """
    asked = f"give (3, H, W) or (H, W, 3), as uint8 or as floats in [0, 1], or {WANTED}"
    shape = tuple(tensor.shape)
    if len(shape) != 3 or 3 not in (shape[0], shape[2]) or not tensor.numel():
        raise InputError(f"{label} is a Tensor of shape {shape}; {asked}.")
    tensor = tensor.detach().cpu()
    if tensor.is_floating_point():
        tensor = tensor.float()
        low, high = (float(value) for value in torch.aminmax(tensor))
        if not (low >= 0 and high <= 1):  # nor NaN
            raise InputError(f"{label} is a Tensor of floats from {low:g} to {high:g}; {asked}.")
        tensor = (tensor * 255).round().to(torch.uint8)
    if tensor.dtype != torch.uint8:
        raise InputError(f"{label} is a Tensor of type {tensor.dtype}; {asked}.")
    upright = tensor if shape[2] == 3 else tensor.permute(1, 2, 0)
    image: Image = np.array(upright.numpy(), order="C")
    return image


def check_image(image: Any, label: str) -> None:
    """Make sure that an image is ``(H, W, 3)`` uint8.

    Raises:
        InputError: If it is not.
    """
    if not isinstance(image, np.ndarray):
        raise InputError(f"{label} is {a_kind(image)}; give {WANTED}.")
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise InputError(f"{label} has shape {image.shape} and type {image.dtype}; give {WANTED}.")
