"""Promptable networks: an encoder run once per frame, and a decoder prompted with boxes, points and masks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Image
from tracking3d.trackers.crops import box_of
from tracking3d.trackers.onnx.description import Decoder, PromptableNetwork
from tracking3d.trackers.onnx.images import (
    Letterbox,
    Proposal,
    fit_image,
    network_input,
    on_image,
    sharpness,
    sigmoid,
)
from tracking3d.trackers.onnx.judging import background_points
from tracking3d.trackers.onnx.saliency import validate_name

Points = NDArray[np.float32]
"""``(N, 3)``: x, y in pixels of the image, and 1 for the object or 0 for the background."""

_LOGIT = 10.0  # of a previous mask's certain pixels; beyond, the sigmoid is flat


class PromptableSegmenter:
    """Runs an image encoder once a frame and its decoder once a prompt.

    Args:
        encoder: The encoder's ONNX file.
        decoder: The decoder's ONNX file.
        description: What they take and give.
        threads: CPU threads.

    Raises:
        InputError: If a file is no network, or has no such input or output.
    """

    def __init__(self, encoder: Path, decoder: Path, description: PromptableNetwork, threads: int) -> None:
        self._description = description
        self._encoder, self._decoder = Network(encoder, threads), Network(decoder, threads)
        names = description.decoder
        self._input = validate_name(description.input.name, self._encoder.inputs, encoder, "input")
        self._output = validate_name(names.masks, self._decoder.outputs, decoder, "output")
        given = [names.points, names.labels, names.mask, names.has_mask, names.frame_size]
        for name in filter(None, given):
            validate_name(name, self._decoder.inputs, decoder, "input")
        self._embeddings = {
            name: validate_name(
                description.embeddings.get(name, name), self._encoder.outputs, encoder, "output"
            )
            for name in self._decoder.inputs
            if name not in given
        }

    def propose(self, image: Image, box: Box, last: NDArray[np.float32] | None) -> list[Proposal]:
        """See `Segmenter.propose`: the box with its centre, alone and with the last mask, and without holes.

        The box is the mean of the box tracker's and the last mask's: the former stays behind on the side of
        the object that it saw first, the latter knows how far the object reaches. The centre keeps the network
        from taking what fills the box's corners for the object.
        """
        look = self.look(image)
        if last is not None and (place := box_of(last)) is not None:
            box = _mean(box, place)
        centre = np.array([[box[0] + box[2] / 2, box[1] + box[3] / 2, 1.0]], np.float32)
        proposals = look.ask(box, centre, origin="box and centre")
        sharpest = max(proposals, key=lambda proposal: proposal.sharpness)
        if last is not None and self._description.decoder.mask is not None:
            proposals += look.ask(box, centre, last, "box, centre and last mask")
        if len(holes := background_points(image, sharpest.mask)):
            negatives = np.column_stack([holes, np.zeros(len(holes), np.float32)])
            proposals += look.ask(box, negatives, origin="box without holes")
        return proposals

    def propose_by_points(self, image: Image, points: Points) -> list[Proposal]:
        """See `PointSegmenter.propose_by_points`: the points alone, and with the box around the best mask of them."""
        look = self.look(image)
        proposals = look.ask(points=points, origin="points")
        sharpest = max(proposals, key=lambda proposal: proposal.sharpness)
        if (place := box_of(sharpest.mask)) is not None:
            proposals += look.ask(place, points, origin="points and their box")
        return proposals

    def look(self, image: Image) -> Look:
        """Run the encoder on ``image`` ``(H, W, 3)``; the result can be queried many times."""
        fit = fit_image(image.shape[:2], self._description.input)
        outputs = self._encoder.run({self._input: network_input(image, fit, self._description.input)})
        embeddings = {name: outputs[source] for name, source in self._embeddings.items()}
        return Look(self._decoder, self._output, self._description.decoder, embeddings, fit)


class Look:
    """An encoded image that a decoder can be asked about."""

    def __init__(
        self,
        network: Network,
        output: str,
        names: Decoder,
        embeddings: dict[str, NDArray],
        fit: Letterbox,
    ) -> None:
        self._network, self._output, self._names = network, output, names
        self._embeddings, self._fit = embeddings, fit

    def ask(
        self,
        box: Box | None = None,
        points: Points | None = None,
        mask: NDArray[np.float32] | None = None,
        origin: str = "prompt",
    ) -> list[Proposal]:
        """Ask for the object.

        Args:
            box: ``(x, y, w, h)`` in pixels of the image.
            points: ``(N, 3)``: x and y in pixels of the image, and 1 for the object or 0 for the background.
            mask: ``(H, W)`` in [0, 1], what the object looked like before.
            origin: What the proposals are called.

        Returns:
            Every mask that the decoder gives.
        """
        names = self._names
        rows = [] if points is None else [tuple(point) for point in points]
        if box is not None:
            x, y, width, height = box
            rows += [(x, y, 2.0), (x + width, y + height, 3.0)]
        elif names.padding_point:
            rows.append((0.0, 0.0, -1.0))
        prompt = np.array(rows, np.float32).reshape(-1, 3)
        feeds = dict(self._embeddings)
        feeds[names.points] = self._shape_prompt(names.points, self._coordinates(prompt[:, :2]))
        feeds[names.labels] = self._shape_prompt(names.labels, prompt[:, 2])
        if names.mask is not None:
            feeds[names.mask] = self._shape_prompt(names.mask, self._logits(mask))
        if names.has_mask is not None:
            feeds[names.has_mask] = self._shape_prompt(
                names.has_mask, np.array([mask is not None], np.float32)
            )
        if names.frame_size is not None:
            feeds[names.frame_size] = self._shape_prompt(
                names.frame_size, np.array(self._fit.image, np.float32)
            )
        output = self._network.run(feeds)[self._output]
        if output.ndim < 2 or not output.size:
            raise InputError(
                f"{self._network.file}: the output '{self._output}' of shape {output.shape} holds no masks; "
                "correct 'decoder.masks' in the description."
            )
        maps = output.reshape(-1, *output.shape[-2:])
        return [
            self._proposal(values, f"{origin}, {i + 1}" if len(maps) > 1 else origin)
            for i, values in enumerate(maps)
        ]

    def _proposal(self, values: NDArray, origin: str) -> Proposal:
        full = on_image(np.nan_to_num(values), self._fit, padded=self._names.grid == "input")
        share = sigmoid(full) if self._names.logits else np.clip(full, 0.0, 1.0)
        return Proposal(share, sharpness(share), origin)

    def _coordinates(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        match self._names.coordinates:
            case "input":
                scale = self._fit.scale
            case "unit":
                scale = 1.0 / np.array(self._fit.image[::-1], np.float32)
            case _:
                return points
        return (points * scale).astype(np.float32)

    def _logits(self, mask: NDArray[np.float32] | None) -> NDArray[np.float32]:
        """The mask on the decoder's grid, which covers the encoder's input with its padding."""
        shape = self._network.inputs[str(self._names.mask)].shape[-2:]
        height, width = (256 if side is None else side for side in shape)
        logits = np.full((height, width), 0.0 if mask is None else -_LOGIT, np.float32)
        if mask is not None:
            rows = max(round(height * self._fit.content[0] / self._fit.input[0]), 1)
            columns = max(round(width * self._fit.content[1] / self._fit.input[1]), 1)
            small = cv2.resize(mask, (columns, rows), interpolation=cv2.INTER_AREA)
            logits[:rows, :columns] = (2.0 * small - 1.0) * _LOGIT
        return logits

    def _shape_prompt(self, name: str, values: NDArray[np.float32]) -> NDArray:
        """``values`` with as many axes, and of the type, that the input wants."""
        info = self._network.inputs[name]
        missing = max(len(info.shape) - values.ndim, 0)
        return values.reshape((1,) * missing + values.shape).astype(info.dtype)


def _mean(a: Box, b: Box) -> Box:
    x, y, width, height = ((first + second) / 2 for first, second in zip(a, b, strict=True))
    return (x, y, width, height)
