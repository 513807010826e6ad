"""The online features of a pixel and their weights: a logistic regression, fitted on many sequences."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.segmentation.colour_models import ColourModels, beside_outline, relative_distance
from tracking3d.estimation.segmentation.pose_weight import relative_confidence

SOURCES = {
    "initial, near": 0.001,
    "initial, at the outline": 0.09,
    "rendered, near": 0.27,
    "rendered, at the outline": 0.205,
    "believed initial, near": 0.262,
    "believed initial, at the outline": 0.048,
    "believed rendered, near": 0.227,
    "believed rendered, at the outline": 0.329,
    "colours beside the outline": 0.519,
    "colours remembered": 0.395,
}
"""Weights of what `pixel_features` gives, by ``training/mask_evidence.py``. "Believed" is by the pose's confidence.

There is no constant: one would say that trackers' masks are too large, as those of the sequences it was fitted on are.
"""

_NEAR, _AT_OUTLINE = 0.08, 0.02  # relative to the root of the area
_MOST = 1.5  # times "near"
_BAND = 0.5  # likewise
_SETTLED = 0.03
"""Mean distance of the outlines from each other, relative to the root of the area, from which on the image decides: an
exact mask and a fitted shape agree within a pixel, a tracker's mask and a shape do not."""
_INITIAL, _RENDERED = (list(SOURCES).index(f"{mask}, near") for mask in ("initial", "rendered"))
_BY_SHAPE = np.array([0.251, 1.108, 0.104, 0.253, -0.277, -0.089, 0.463, 0.607])
"""Of the first eight, where colours are not asked; fitted likewise."""


def pixel_features(
    lab: NDArray[np.uint8],
    initial: NDArray[np.bool_],
    rendered: NDArray[np.bool_],
    confidence: float,
    colours: ColourModels | None,
) -> NDArray[np.float32]:
    """``(S, S, 10)`` what the `SOURCES` say, positive where it speaks for the object.

    Args:
        lab: ``(S, S, 3)`` crop in 8-bit Lab.
        initial: ``(S, S)`` the mask tracker's mask.
        rendered: ``(S, S)`` the silhouette at the frame's pose.
        confidence: The confidence of the pose, in [0, 1].
        colours: What earlier frames showed, or None.
    """
    shapes = []
    for mask in (initial, rendered):
        distance = relative_distance(mask)
        shapes += [np.clip(distance / _NEAR, -_MOST, _MOST), np.tanh(distance / _AT_OUTLINE)]
    shapes += [relative_confidence(confidence) * one for one in shapes]
    # Colours are those on either side of where the shapes put the outline.
    likely = np.tensordot(_BY_SHAPE, np.stack(shapes), 1) > 0
    nearby = beside_outline(lab, likely, few=True) if likely.any() else np.zeros(likely.shape, np.float32)
    remembered = np.zeros_like(nearby) if colours is None else colours.log_ratio(lab)
    asked = _query_share(shapes[_INITIAL], shapes[_RENDERED])
    return np.stack([*shapes, asked * nearby, asked * remembered], -1).astype(np.float32)


def image_weight(features: NDArray[np.float32]) -> float:
    """How far the image has to be asked, in [0, 1]: little where both outlines agree, for they are more exact then."""
    return _query_share(features[..., _INITIAL], features[..., _RENDERED])


def _query_share(initial: NDArray[np.float32], rendered: NDArray[np.float32]) -> float:
    band = np.minimum(np.abs(initial), np.abs(rendered)) < _BAND
    apart = _NEAR * float(np.abs(initial - rendered)[band].mean()) if band.any() else _NEAR * _MOST
    return min(apart / _SETTLED, 1.0)


def log_odds(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """``(S, S)`` log-odds of the object; nothing far from both outlines is the object's."""
    total = features @ np.array(list(SOURCES.values()), np.float32)
    beyond = np.maximum(features[..., _INITIAL], features[..., _RENDERED]) <= -_MOST
    return np.where(beyond, -6.0, total).astype(np.float32)
