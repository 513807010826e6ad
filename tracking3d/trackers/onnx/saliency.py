"""Saliency networks on a crop around the box: the salient region is taken as the object."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Image
from tracking3d.trackers.onnx.description import SaliencyNetwork
from tracking3d.trackers.onnx.images import (
    Proposal,
    enlarge,
    fit_image,
    network_input,
    on_image,
    sharpness,
    sigmoid,
)

# Nothing beyond the box, enlarged by this, is the object; the user's first box is nearer to it than a
# tracker's.
_FIRST_SLACK, _SLACK = 1.05, 1.1


class SaliencySegmenter:
    """Runs a saliency network on the box, enlarged by one or more factors.

    Args:
        file: The ONNX file.
        description: What it takes and gives.
        crops: Factors by which the box is enlarged; each gives a proposal.
        threads: CPU threads.

    Raises:
        InputError: If the file is no network, or has no such input or output.
    """

    def __init__(
        self, file: Path, description: SaliencyNetwork, crops: tuple[float, ...], threads: int
    ) -> None:
        self._description, self._crops = description, crops
        self._network = Network(file, threads)
        self._input = validate_name(description.input.name, self._network.inputs, file, "input")
        self._output = validate_name(description.output, self._network.outputs, file, "output")

    def propose(self, image: Image, box: Box, last: NDArray[np.float32] | None) -> list[Proposal]:
        """See `Segmenter.propose`: what stands out in each crop, as far as it lies about the box.

        The box is not moved towards the last mask: a hand that was once taken for a part of the object would
        bring more of itself into the crop.
        """
        limits = enlarge(box, _FIRST_SLACK if last is None else _SLACK, image.shape)
        return [self._proposal(image, box, factor, limits) for factor in self._crops]

    def _proposal(self, image: Image, box: Box, factor: float, limits: tuple[slice, slice]) -> Proposal:
        rows, columns = enlarge(box, factor, image.shape)
        crop = image[rows, columns]
        fit = fit_image(crop.shape[:2], self._description.input)
        feeds = {self._input: network_input(crop, fit, self._description.input)}
        shares = self._shares(self._network.run(feeds)[self._output])
        whole = np.zeros(image.shape[:2], np.float32)
        whole[rows, columns] = on_image(shares, fit, padded=True)
        mask = np.zeros_like(whole)
        mask[limits] = whole[limits]
        return Proposal(mask, sharpness(mask), f"crop enlarged {factor:g} times")

    def _shares(self, output: NDArray) -> NDArray[np.float32]:
        """``(h, w)`` in [0, 1]."""
        file, wanted = self._network.file, self._description.channel
        maps = output.reshape(-1, *output.shape[-2:]) if output.ndim >= 2 else output
        if maps.ndim != 3 or wanted >= len(maps) or not maps.size:
            raise InputError(
                f"{file}: the output '{self._output}' of shape {output.shape} has no channel {wanted} of an "
                "image; correct 'output' and 'channel' in the description."
            )
        maps = maps.astype(np.float32)
        match self._description.activation:
            case "sigmoid":
                shares = sigmoid(maps[wanted])
            case "softmax":
                powers = np.exp(maps - maps.max(0))
                shares = powers[wanted] / powers.sum(0)
            case _:
                shares = maps[wanted]
        if self._description.normalise:
            low, high = float(shares.min()), float(shares.max())
            shares = (shares - low) / max(high - low, 1e-6)
        return np.clip(shares, 0.0, 1.0)


def validate_name(name: str | None, names: Mapping[str, object], file: Path, what: str) -> str:
    """``name``, or the first of the network's ``names`` if it is None; an error if there is none such."""
    if name is None:
        return next(iter(names))
    if name not in names:
        raise InputError(
            f"{file} has no {what} '{name}' (it has {', '.join(names)}); correct it in the description."
        )
    return name
