"""OSTrack in an ONNX file: the box of the object in the next frame.

Crops, window, decoding and limits are those of the project (https://github.com/botaoye/OSTrack,
``lib/test/tracker/ostrack.py``, ``lib/models/layers/head.py``, experiment ``vitb_256_mae_32x4_ep300``).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Image
from tracking3d_ostrack.patches import Patch

_TEMPLATE, _SEARCH = 2.0, 4.0  # sides of the crops over the square root of the box's area
_TEMPLATE_SIZE, _SEARCH_SIZE = 128, 256
_MARGIN = 10  # pixels of the frame that a box keeps
_MAPS = ("score_map", "size_map", "offset_map")
_README = "see the README of tracking3d-ostrack for the export"


class OsTrackBoxes:
    """Follows a box.

    Args:
        network: Inputs ``template`` and ``search``; outputs ``score_map``, ``size_map`` and ``offset_map``, or
            ``pred_boxes``.

    Raises:
        InputError: If it has other inputs or outputs.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        for name in ("template", "search"):
            info = network.inputs.get(name)
            if info is None or len(info.shape) != 4 or info.shape[1] not in (3, None):
                raise InputError(
                    f"{network.file} is no export of OSTrack: it has no input '{name}' (1, 3, height, width); "
                    f"{_README}."
                )
        if not set(_MAPS) <= network.outputs.keys() and "pred_boxes" not in network.outputs:
            raise InputError(
                f"{network.file} is no export of OSTrack: it has neither the outputs {', '.join(_MAPS)} nor "
                f"pred_boxes; {_README}."
            )
        self._template_size = network.inputs["template"].shape[-1] or _TEMPLATE_SIZE
        self._search_size = network.inputs["search"].shape[-1] or _SEARCH_SIZE
        self._template: NDArray[np.float32] | None = None
        self.box: Box = (0.0, 0.0, 1.0, 1.0)

    def start(self, image: Image, box: Box) -> None:
        """Take ``box`` ``(x, y, w, h)`` in ``image`` ``(H, W, 3)`` for the object."""
        self.box = box
        self._template = Patch.square(box, _TEMPLATE, self._template_size).cut(image)

    def update(self, image: Image) -> tuple[Box, float]:
        """The box in the next image, and the peak of the score, from 0 to 1."""
        assert self._template is not None, "start comes first"
        patch = Patch.square(self.box, _SEARCH, self._search_size)
        answers = self._network.run({"template": self._template, "search": patch.cut(image)})
        if set(_MAPS) <= answers.keys():
            found, score = _decoded(answers, self._network)
        else:
            found, score = answers["pred_boxes"].reshape(-1, 4).mean(axis=0), 1.0
        if not np.isfinite(found).all():
            return self.box, 0.0
        x, y, width, height = (float(value) * self._search_size for value in found)
        box = patch.box_out((x - width / 2, y - height / 2, width, height))
        self.box = _clipped(box, image.shape)
        return self.box, min(max(score, 0.0), 1.0)


def _decoded(answers: Mapping[str, NDArray], network: Network) -> tuple[NDArray, float]:
    """``(4,)`` centre and size of the best box as shares of the crop, and its score."""
    scores, sizes, offsets = (answers[name] for name in _MAPS)
    side = scores.shape[-1]
    if scores.shape != (1, 1, side, side) or not sizes.shape == offsets.shape == (1, 2, side, side):
        raise InputError(
            f"{network.file} answers with maps of {scores.shape}, {sizes.shape} and {offsets.shape} instead of "
            f"(1, 1, n, n), (1, 2, n, n) and (1, 2, n, n); {_README}."
        )
    window = 0.5 * (1 - np.cos(2 * np.pi / (side + 1) * np.arange(1, side + 1)))
    best = int((scores[0, 0] * np.outer(window, window)).argmax())
    row, column = divmod(best, side)
    width, height = sizes[0, :, row, column]
    right, down = offsets[0, :, row, column]
    box = np.array([(column + right) / side, (row + down) / side, width, height])
    return box, float(scores[0, 0, row, column])


def _clipped(box: Box, shape: tuple[int, ...]) -> Box:
    """The part of the box inside the frame, of at least `_MARGIN` pixels where the frame has them."""
    parts = []
    for start, length, limit in ((box[0], box[2], shape[1]), (box[1], box[3], shape[0])):
        margin = min(_MARGIN, limit)
        first = min(max(start, 0.0), float(limit - margin))
        last = min(max(start + length, float(margin)), float(limit))
        parts.append((first, max(last - first, float(margin))))
    (x, width), (y, height) = parts
    return x, y, width, height
