"""Keypoints by a small network, trained by this project."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from tracking3d.features.networks.session import Network
from tracking3d.features.networks.store import find_network
from tracking3d.features.protocol import Keypoints

_MULTIPLE = 32  # pixels of which the network takes whole numbers
_PEAK = 5  # pixels along the side of the square in which a keypoint has the highest score (EdgePoint2)
_BORDER = 4  # pixels along the border without keypoints (EdgePoint2)
_RATIO = 0.9  # largest ratio of the distances to the two best matches (measured)


class NetworkDetector:
    """Keypoint detector ``network``, in the shape of EdgePoint2 (Yao et al. 2025); ``training/keypoints`` made it."""

    rotation_invariant = False

    class Options(BaseModel):
        """Options of ``network``."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        model: str | None = Field(
            None,
            description="ONNX file, or known name, of another such network; null takes the one of the package.",
        )
        least_score: float = Field(-9.0, description="Least logit of a keypoint; EdgePoint2's own is -5.")
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")

    def __init__(self, options: NetworkDetector.Options) -> None:
        self._least_score = options.least_score
        own = resources.files("tracking3d.features") / "weights" / "keypoints.onnx"
        with resources.as_file(own) as file:
            self._network = Network(find_network(options.model or Path(file)), options.threads)

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the detector from its validated options."""
        return cls(cls.Options.model_validate(options.model_dump()))

    def detect(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_], most: int, contrast: float
    ) -> Keypoints:
        """The keypoints of the highest scores inside a mask, between pixels; compared by cosines."""
        height, width = image.shape
        border = (0, -height % _MULTIPLE, 0, -width % _MULTIPLE)
        padded = cv2.copyMakeBorder(image, *border, cv2.BORDER_REPLICATE)
        answer = self._network.run({"x": padded[None, None].astype(np.float32) / 255})
        score, descriptors = answer["score"][0, 0, :height, :width], answer["desc"][0]
        peaks = (score == cv2.dilate(score, np.ones((_PEAK, _PEAK)))) & mask
        peaks &= score > self._least_score + np.log(contrast)
        peaks[:_BORDER] = peaks[-_BORDER:] = peaks[:, :_BORDER] = peaks[:, -_BORDER:] = False
        y, x = np.nonzero(peaks)
        best = np.argsort(-score[y, x], kind="stable")[:most]
        y, x = y[best], x[best]
        pixel = np.stack([x + _peak(score[y, x - 1], score[y, x], score[y, x + 1]),
                          y + _peak(score[y - 1, x], score[y, x], score[y + 1, x])], 1)  # fmt: skip
        at = (pixel + 0.5) * descriptors.shape[1] / padded.shape[0] - 0.5
        at = at.clip(0, np.array(descriptors.shape[:0:-1]) - 1.001)
        (x, y), (right, down) = at.astype(int).T, (at % 1).T
        upper = (1 - right) * descriptors[:, y, x] + right * descriptors[:, y, x + 1]
        lower = (1 - right) * descriptors[:, y + 1, x] + right * descriptors[:, y + 1, x + 1]
        sampled = ((1 - down) * upper + down * lower).T
        return Keypoints(pixel.astype(np.float32), sampled.astype(np.float32), "cosine", _RATIO)


def _peak(
    before: NDArray[np.float32], at: NDArray[np.float32], after: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Pixels from the middle one of three to the peak of a parabola through them, at most half a pixel."""
    return np.clip(0.5 * (after - before) / np.maximum(2 * at - before - after, 1e-6), -0.5, 0.5)
