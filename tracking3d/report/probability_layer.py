"""Object probabilities as overlays for a page: small images of sixteen colours.

Blue is hardly, yellow is surely the object, as in the viewer; what is below a thirtieth is transparent.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.results.run_reader import RunReader

BUDGET = 1_200_000
"""Bytes of all layers of a page; as text in the page they take a third more."""
WIDEST = 320
"""Pixels across a layer; the page stretches it over the picture."""
_STEPS = 16
_FAINTEST, _STRONGEST = 40, 150  # of 255; what is hardly the object's is hardly covered


def probability_layers(
    run: RunReader, positions: Sequence[int], budget: int = BUDGET
) -> tuple[bytes | None, ...]:
    """A layer as PNG for each of some estimates; None for one without a probability, nothing if none has one.

    Args:
        run: The run.
        positions: Positions in ``run.frames``.
        budget: Bytes of all layers together; they get smaller until they fit.
    """
    width = min(WIDEST, run.camera.width)
    shown = [_grey(run.probability(run.frames[position].index), width) for position in positions]
    if all(one is None for one in shown):
        return ()
    layers = list(map(_encode, shown))
    while sum(len(layer) for layer in layers if layer) > budget and width > 16:
        width = width * 3 // 4
        layers = [_encode(None if one is None else _shrunk(one, width)) for one in shown]
    return tuple(layers)


def _grey(probability: NDArray[np.float32] | None, width: int) -> NDArray[np.uint8] | None:
    """0 to 255: a long run has hundreds of them at a time."""
    if probability is None:
        return None
    return _shrunk(np.rint(255 * probability).clip(0, 255).astype(np.uint8), width)


def _shrunk(grey: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    height, before = grey.shape
    shape = (width, max(round(width * height / before), 1))
    return cv2.resize(grey, shape, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _encode(grey: NDArray[np.uint8] | None) -> bytes | None:
    if grey is None:
        return None
    image = Pillow.fromarray(np.rint(grey / 255 * (_STEPS - 1)).astype(np.uint8))
    image.putpalette(_palette())
    written = io.BytesIO()
    transparency = bytes([0, *np.linspace(_FAINTEST, _STRONGEST, _STEPS - 1).astype(np.uint8)])
    image.save(written, "PNG", bits=4, transparency=transparency, optimize=True)
    return written.getvalue()


def _palette() -> list[int]:
    """Viridis, as the viewer has it."""
    greys = np.rint(np.linspace(0, 255, _STEPS)).astype(np.uint8)[None]
    return [int(value) for value in cv2.applyColorMap(greys, cv2.COLORMAP_VIRIDIS)[0, :, ::-1].ravel()]
