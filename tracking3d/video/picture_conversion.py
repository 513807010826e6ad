"""Decoded pictures as upright sRGB arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import av
import cv2
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from tracking3d.frames import Image


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
    """How the file asks for the picture to be turned, see `tracking3d.video.picture_conversion`."""
    matrix: Any = picture.side_data.get("DISPLAYMATRIX")
    return UPRIGHT if matrix is None else orientation_from_display_matrix(bytes(matrix))


def said_of(picture: av.VideoFrame) -> tuple[str, ...]:
    """What is done to pictures such as this one beyond turning them, in clauses."""
    tone_mapping = tone_mapping_of(picture)
    said = [] if tone_mapping is None else [tone_mapping.said]
    if picture.interlaced_frame:
        said.append("the video is interlaced; frames were deinterlaced (bwdif)")
    return tuple(said)


# Tone mapping of HDR to sRGB: luminance above diffuse white is compressed, wide colours are converted.
#
# Signals become light in cd/m2 by the transfer function that the video names, PQ (SMPTE ST 2084) or HLG, both in ITU-R
# BT.2100. Light up to `SOURCE_PEAK` is brought below `WHITE` by the EETF of Report ITU-R BT.2390 (5.4.1), by the
# brightest of the three channels, so that hues stay. BT.2020's primaries become BT.709's (ITU-R BT.2087), and the
# result is encoded as sRGB (IEC 61966-2-1). `WHITE` is the white of BT.2408, so that faces and paper are as bright as
# in an SDR video.

WHITE = 203.0
"""cd/m2 of the white of SDR (Report ITU-R BT.2408)."""
SOURCE_PEAK = 1000.0
"""Assumed mastering luminance of videos in cd/m2."""

_TO_709 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]],
    np.float32,
)
_LUMA_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)
# Numbers of ITU-T H.273.
_HDR, _BT2020, _UNSPECIFIED = {16: "PQ", 18: "HLG"}, 9, 2
_FINE = 4095  # steps of light before it is encoded


@dataclass(frozen=True)
class ToneMapping:
    """How pictures of one video become sRGB."""

    transfer: str  # "PQ", "HLG", or "SDR" of wide colours that need no rolling off
    wide: bool  # whether primaries are BT.2020's

    @property
    def said(self) -> str:
        """A clause for who looks at the run."""
        colours = "the wide colours of BT.2020" if self.wide else "its colours"
        if self.transfer == "SDR":
            return f"{colours} were converted to sRGB"
        how = f"BT.2390, {SOURCE_PEAK:g} to {WHITE:g} cd/m2"
        return f"the video is HDR ({self.transfer}); it was tone-mapped to sRGB ({how})"

    def __call__(self, signal: NDArray[np.uint16]) -> Image:
        """``(H, W, 3)`` uint16 R'G'B' of full range as uint8 sRGB."""
        codes = signal >> 6
        light = _light(self.transfer)[codes]
        if self.transfer == "PQ":
            light *= _roll_off_codes()[codes.max(2)][..., None]
        if self.transfer == "HLG":
            # The display's gamma, which follows the brightness of the scene.
            gain = SOURCE_PEAK * cv2.pow(cv2.transform(light, _LUMA_2020[None]), 0.2)
            peak = np.sqrt(gain * light.max(2) / SOURCE_PEAK) * _FINE
            light *= (gain * _roll_off_roots()[np.minimum(peak + 0.5, _FINE).astype(np.uint16)])[..., None]
        if self.wide:
            light = cv2.transform(light, _TO_709)
        steps = (np.clip(light, 0.0, 1.0) * _FINE + 0.5).astype(np.uint16)
        return cast(Image, _srgb()[steps])


def tone_mapping_of(picture: av.VideoFrame) -> ToneMapping | None:
    """What a decoded picture needs to be sRGB; None if it is that already, nearly."""
    primaries = getattr(picture, "color_primaries", _UNSPECIFIED)  # older versions of PyAV do not tell
    wide = primaries == _BT2020
    hdr = _HDR.get(getattr(picture, "color_trc", _UNSPECIFIED))
    if hdr is not None:  # whose primaries are BT.2020's if nobody says
        return ToneMapping(hdr, wide or primaries == _UNSPECIFIED)
    return ToneMapping("SDR", True) if wide else None


def pq_to_light(signal: NDArray) -> NDArray[np.float64]:
    """cd/m2 of PQ signals in [0, 1] (BT.2100, table 4)."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = np.power(signal, 1 / m2)
    return 10_000 * np.power(np.maximum(power - c1, 0) / (c2 - c3 * power), 1 / m1)


def light_to_pq(light: NDArray) -> NDArray[np.float64]:
    """The inverse of `pq_to_light`."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = np.power(np.asarray(light) / 10_000, m1)
    return np.power((c1 + c2 * power) / (1 + c3 * power), m2)


def hlg_to_scene(signal: NDArray) -> NDArray[np.float64]:
    """Light of the scene in [0, 1] of HLG signals in [0, 1] (BT.2100, table 5)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


_TRANSFERS: dict[str, Callable[[NDArray], NDArray[np.float64]]] = {
    "PQ": pq_to_light,
    "HLG": hlg_to_scene,
    "SDR": lambda signal: np.power(signal, 2.4),  # BT.1886
}


@lru_cache(maxsize=4)
def _light(transfer: str) -> NDArray[np.float32]:
    """Light of all signals of 10 bits."""
    return _TRANSFERS[transfer](np.arange(1024) / 1023).astype(np.float32)


@lru_cache(maxsize=1)
def _roll_off_codes() -> NDArray[np.float32]:
    """Factors for the brightest channel's PQ signal of 10 bits; light is then 1 at `WHITE`."""
    return _roll_off(pq_to_light(np.arange(1024) / 1023))


@lru_cache(maxsize=1)
def _roll_off_roots() -> NDArray[np.float32]:
    """The same for the root of the brightest channel's light, in steps of `_FINE` up to `SOURCE_PEAK`."""
    return _roll_off((np.arange(_FINE + 1) / _FINE) ** 2 * SOURCE_PEAK)


def _roll_off(light: NDArray[np.float64]) -> NDArray[np.float32]:
    """The factors that bring light in cd/m2 below 1, which is `WHITE`: BT.2390's Hermite spline over PQ."""
    most = float(light_to_pq(np.array(SOURCE_PEAK)))
    signal = np.minimum(light_to_pq(light) / most, 1.0)
    white = float(light_to_pq(np.array(WHITE))) / most
    knee = 1.5 * white - 0.5
    t = np.clip((signal - knee) / (1 - knee), 0.0, 1.0)
    spline = (
        (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * white
    )
    target = pq_to_light(np.where(signal < knee, signal, spline) * most)
    factor = np.divide(target, light, out=np.ones_like(light), where=light > 0) / WHITE
    return factor.astype(np.float32)


@lru_cache(maxsize=1)
def _srgb() -> NDArray[np.uint8]:
    linear = np.arange(_FINE + 1) / _FINE
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)


UPRIGHT = 1
"""The EXIF orientation of an image that is stored upright."""

_TURNS: dict[int, Callable[[Image], Image]] = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.transpose(1, 0, 2),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: image[::-1, ::-1].transpose(1, 0, 2),
    8: lambda image: np.rot90(image),
}

# By the signs of (a, b, c, d) where a stored pixel (x, y) is shown at (a x + c y, b x + d y).
_ORIENTATIONS = {
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}


def turn_upright(image: Image, orientation: int) -> Image:
    """Turn and mirror a stored picture so that it is as it is to be seen.

    Args:
        image: ``(H, W, 3)`` as stored.
        orientation: EXIF orientation 1 to 8 (Exif 2.32, tag 0x0112); any other value changes nothing.

    Returns:
        ``(H, W, 3)`` or ``(W, H, 3)``, contiguous.
    """
    return np.ascontiguousarray(_TURNS.get(orientation, _TURNS[UPRIGHT])(image))


def orientation_from_display_matrix(matrix: bytes) -> int:
    """The EXIF orientation that a video's display matrix asks for, to the nearest quarter turn.

    Args:
        matrix: Nine int32 in native byte order ``(a, b, u, c, d, v, x, y, w)``, as FFmpeg gives them
            (ISO/IEC 14496-12, 8.3.2; https://ffmpeg.org/doxygen/trunk/group__lavu__video__display.html).
    """
    a, b, _, c, d, *_ = np.frombuffer(matrix, np.int32, 9).astype(np.int64)
    if abs(a) + abs(d) >= abs(b) + abs(c):
        b = c = 0
    else:
        a = d = 0
    return _ORIENTATIONS.get((np.sign(a), np.sign(b), np.sign(c), np.sign(d)), UPRIGHT)
