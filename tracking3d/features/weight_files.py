"""Loading weights of torch networks without executing code: only torch's restricted unpickler is used."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from tracking3d.errors import InputError

_WRAPPED = ("state_dict", "extractor", "model")
"""Keys under which checkpoints store the weights."""


def read_weights(file: Path) -> dict[str, Tensor]:
    """The tensors of a ``.safetensors``, ``.pth`` or ``.pt`` file by name.

    Args:
        file: The file; one that holds them under ``state_dict``, ``extractor`` or ``model`` will do.

    Raises:
        InputError: If there is no such file, or it holds anything but tensors.
    """
    if not file.is_file():
        raise InputError(f"The weights {file} do not exist; give the path of a file that you have.")
    try:
        if file.suffix == ".safetensors":
            import safetensors.torch

            return safetensors.torch.load_file(file)
        loaded = torch.load(file, map_location="cpu", weights_only=True)
    except ImportError as error:
        raise InputError(f"{file} needs the package safetensors; install it, or give a .pth file.") from error
    except Exception as error:  # damaged files make the readers raise many kinds
        raise InputError(
            f"{file} cannot be read as weights, or holds objects other than tensors, which are not loaded; "
            "give a .safetensors "
            "file, or a .pth file with a state dict."
        ) from error
    for key in _WRAPPED:
        if isinstance(loaded, dict) and isinstance(loaded.get(key), dict):
            loaded = loaded[key]
    if not isinstance(loaded, dict) or not all(isinstance(value, Tensor) for value in loaded.values()):
        raise InputError(f"{file} holds no state dict of tensors; give the weights alone.")
    return loaded


def load_weights(network: nn.Module, file: Path, name: str) -> None:
    """Put the weights of a file into a network, all of them.

    Args:
        network: The network.
        file: See `read_weights`.
        name: What messages call the network.

    Raises:
        InputError: If they cannot be read, or are of another network.
    """
    weights, wanted = read_weights(file), network.state_dict()
    wrong = [
        key
        for key, value in wanted.items()
        if not key.endswith("num_batches_tracked")
        and (key not in weights or weights[key].shape != value.shape)
    ]
    if wrong:
        raise InputError(
            f"{file} does not hold the weights of {name}: {wrong[0]} is missing or of another size; give its file, or "
            "set features.descriptor."
        )
    network.load_state_dict({key: weights[key] for key in wanted if key in weights}, strict=False)
