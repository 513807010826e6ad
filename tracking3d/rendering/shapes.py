"""Shapes of tensors, checked where they enter the renderer."""

from __future__ import annotations

from torch import Tensor


def check_shapes(**tensors: tuple[Tensor, str]) -> None:
    """Compare tensors with shapes in letters; a letter stands for one size wherever it appears.

    ``check_shapes(R=(R, "B 3 3"), t=(t, "B 3"))`` wants as many translations as rotations.

    Args:
        **tensors: Each tensor with its expected shape, separated by spaces.

    Raises:
        ValueError: If a shape does not fit; it names the tensor, its shape and the expected one.
    """
    known: dict[str, int] = {}
    for name, (tensor, shape) in tensors.items():
        letters = shape.split()
        sizes = {**known, **{letter: int(letter) for letter in letters if letter.isdigit()}}
        fits = tensor.dim() == len(letters) and all(
            sizes.setdefault(letter, size) == size for letter, size in zip(letters, tensor.shape, strict=True)
        )
        if not fits:
            expected = ", ".join(str(known.get(letter, letter)) for letter in letters)
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected ({expected})")
        known = sizes
