"""Keypoints by EdgePoint2-T32 (Yao et al. 2025), whose file lies beside this one: a tracking3d plug-in."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from tracking3d.features.keypoint_network import NetworkDetector
from tracking3d.features.protocol import Keypoints


class EdgePoint2Detector:
    """Keypoint detector ``edgepoint2``: 27,524 parameters, descriptors of 32 channels.

    It fulfils the protocol ``tracking3d.features.protocol.KeypointDetector``, by the detector ``network`` with the
    file of this package.

    Args:
        network: The detector that runs the file.
    """

    rotation_invariant = False

    class Options(BaseModel):
        """What can be set in YAML under ``keypoints:`` or with ``--set keypoints.<name>=...``."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        least_score: float = Field(-9.0, description="Least logit of a keypoint; EdgePoint2's own is -5.")
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")

    def __init__(self, network: NetworkDetector) -> None:
        self._network = network

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Load the network."""
        given = cls.Options.model_validate(options.model_dump())
        model = str(Path(__file__).with_name("t32.onnx"))
        return cls(NetworkDetector(NetworkDetector.Options(model=model, **given.model_dump())))

    def detect(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_], most: int, contrast: float
    ) -> Keypoints:
        """The keypoints of the highest scores inside a mask, with ``(N, 32)`` descriptors compared by cosines."""
        return self._network.detect(image, mask, most, contrast)
