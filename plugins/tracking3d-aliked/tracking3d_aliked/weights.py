"""Weights from files, with nothing in them run: no pickle but torch's restricted one."""

from __future__ import annotations

from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor

from tracking3d.errors import InputError


def read_weights(file: Path) -> dict[str, Tensor]:
    """The tensors of a ``.safetensors``, ``.pth`` or ``.pt`` file by name.

    Args:
        file: The file; one that holds them under ``state_dict`` will do.

    Raises:
        InputError: If there is no such file, or it holds anything but tensors.
    """
    if not file.is_file():
        raise InputError(
            f"The weights {file} do not exist; see the README of tracking3d-aliked for where to get them."
        )
    if file.suffix == ".onnx":
        raise InputError(
            f"{file} is an ONNX network; run it with --features onnx --set features.model={file}."
        )
    try:
        if file.suffix == ".safetensors":
            return safetensors.torch.load_file(file)
        loaded = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged files make the readers raise many kinds
        raise InputError(
            f"{file} cannot be read as weights, or holds more than tensors, which is not loaded; give a .safetensors "
            "file, or a .pth file with a state dict."
        ) from error
    tensors = loaded.get("state_dict", loaded) if isinstance(loaded, dict) else None
    if not isinstance(tensors, dict) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise InputError(f"{file} holds no state dict of tensors; give the weights alone.")
    return tensors
