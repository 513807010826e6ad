"""AlphaRefine in an ONNX file: the mask of the object in a box.

Crops and preparation are those of the project (https://github.com/MasterBin-IIAU/AlphaRefine,
``pytracking/refine_modules/refine_module.py``, ``alpha/base/ARcm_r34``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Image
from tracking3d_ostrack.patches import Patch

_SEARCH = 2.0  # sides of the crop over those of the box
_SIZE = 256
_INPUTS = ("train_imgs", "train_bb", "test_imgs")
_README = "see the README of tracking3d-ostrack for the export"


class AlphaRefine:
    """Finds the mask of the object of the first frame in a box of another.

    Args:
        network: Inputs ``train_imgs``, ``train_bb`` and ``test_imgs``; output ``mask``.

    Raises:
        InputError: If it has other inputs or outputs.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        if missing := [name for name in _INPUTS if name not in network.inputs]:
            raise InputError(
                f"{network.file} is no export of AlphaRefine: it has no input '{missing[0]}'; {_README}."
            )
        if "mask" not in network.outputs:
            raise InputError(
                f"{network.file} is no export of AlphaRefine: it has no output 'mask'; {_README}."
            )
        shape = network.inputs["test_imgs"].shape
        self._size = (shape[-1] if shape else None) or _SIZE
        self._reference: dict[str, NDArray[np.float32]] = {}

    def start(self, image: Image, box: Box) -> None:
        """Take ``box`` ``(x, y, w, h)`` in ``image`` ``(H, W, 3)`` for the object."""
        patch = Patch.stretch_to(box, _SEARCH, self._size)
        inside = np.array([patch.box_in(box)], np.float32)
        inside[0, :2] -= 0.5  # the project counts from the middle of the first pixel
        self._reference = {"train_imgs": patch.cut(image), "train_bb": inside}

    def mask(self, image: Image, box: Box) -> NDArray[np.float32]:
        """``(H, W)``: the probability of the object; 0 where the crop around ``box`` does not reach."""
        patch = Patch.stretch_to(box, _SEARCH, self._size)
        answers = self._network.run({**self._reference, "test_imgs": patch.cut(image)})
        mask = np.squeeze(answers["mask"])
        if mask.shape != (self._size, self._size):
            raise InputError(
                f"{self._network.file} answers with a mask of {answers['mask'].shape} instead of (1, 1, {self._size}, "
                f"{self._size}); {_README}."
            )
        return np.clip(np.nan_to_num(patch.paste(mask, image.shape)), 0, 1)
