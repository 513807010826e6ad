"""The protocols of feature encoders, whose features the appearance loss compares, and of keypoint detectors.

A plug-in is a class registered under the entry-point group ``tracking3d.features`` or ``tracking3d.keypoints``. It
knows tensors and arrays, never the pipeline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

if TYPE_CHECKING:
    from torch import Tensor


@runtime_checkable
class FeatureEncoder(Protocol):
    """Turns images into dense feature maps.

    A class that implements it has a nested pydantic model ``Options`` and a classmethod
    ``from_options(options)``.

    Attributes:
        channels: Number of feature channels C.
        stride: Input pixels per feature pixel.
        tau: Convergence threshold of the appearance loss for these features (paper section 3.4: 0.2 for RGB,
            0.05 for S2DNet).
    """

    channels: int
    stride: int
    tau: float

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build an encoder from its validated ``Options``."""
        ...

    def encode(self, images: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` RGB in [0, 1] as ``(B, C, H / stride, W / stride)``."""
        ...


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one picture. A corner with two orientations occurs twice, since either descriptor may match."""

    pixel: NDArray[np.float32]  # (M, 2) float32
    descriptor: NDArray[np.float32]  # (M, D) float32
    # how descriptors are compared: by their dot product after each is scaled to length 1, or by that of the roots of
    # its shares (RootSIFT, Arandjelovic and Zisserman 2012)
    similarity: Literal["cosine", "hellinger"] = "hellinger"
    ratio: float = 0.8  # largest ratio of the distances to the best and the second-best match

    @classmethod
    def none(cls) -> Keypoints:
        """No keypoints."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))

    def __len__(self) -> int:
        return len(self.pixel)


@runtime_checkable
class KeypointDetector(Protocol):
    """Finds and describes keypoints.

    A class that implements it has a nested pydantic model ``Options`` and a classmethod
    ``from_options(options)``.

    Attributes:
        rotation_invariant: Whether descriptors stay the same when the picture is turned in its plane. If not, pictures
            are turned upright by the predicted pose, and in four ways if there is none.
    """

    rotation_invariant: bool

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build a detector from its validated ``Options``."""
        ...

    def detect(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_], most: int, contrast: float
    ) -> Keypoints:
        """The strongest keypoints inside a mask.

        Args:
            image: ``(H, W)`` grey, scaled so that the object has a fixed size.
            mask: ``(H, W)``.
            most: The most keypoints.
            contrast: The least contrast of a keypoint over the usual one: below 1 where fainter ones are wanted.
        """
        ...
