"""Decoded pictures as upright sRGB arrays."""

from __future__ import annotations

from typing import Any, cast

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.video.orientation import UPRIGHT, orientation_from_display_matrix, turn_upright
from tracking3d.video.tone_mapping import ToneMapping, tone_mapping_of


class PictureConverter:
    """Converts the pictures of one video to arrays; the first one determines rotation and tone mapping."""

    def __init__(self) -> None:
        # Asked once, because asking PyAV for side data keeps the picture until Python collects cycles.
        self._orientation: int | None = None
        self._tone_mapping: ToneMapping | None = None

    def __call__(self, picture: av.VideoFrame) -> Image:
        """``(H, W, 3)`` uint8 sRGB, upright.

        Raises:
            ValueError: If the pixels cannot be converted; says why.
        """
        if self._orientation is None:
            self._orientation, self._tone_mapping = orientation_of(picture), tone_mapping_of(picture)
        try:
            if self._tone_mapping is None:
                image = cast(Image, picture.to_ndarray(format="rgb24"))
            else:
                image = self._tone_mapping(cast("NDArray[np.uint16]", picture.to_ndarray(format="rgb48le")))
        except (FFmpegError, ValueError) as error:
            raise ValueError(f"its pixels cannot be converted to RGB: {error}") from error
        return turn_upright(image, self._orientation)


def orientation_of(picture: av.VideoFrame) -> int:
    """How the file asks for the picture to be turned, see `tracking3d.video.orientation`."""
    matrix: Any = picture.side_data.get("DISPLAYMATRIX")
    return UPRIGHT if matrix is None else orientation_from_display_matrix(bytes(matrix))


def said_of(picture: av.VideoFrame) -> tuple[str, ...]:
    """What is done to pictures such as this one beyond turning them, in clauses."""
    tone_mapping = tone_mapping_of(picture)
    said = [] if tone_mapping is None else [tone_mapping.said]
    if picture.interlaced_frame:
        said.append("the video is interlaced; frames were deinterlaced (bwdif)")
    return tuple(said)
