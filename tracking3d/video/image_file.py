"""Reading an image file as RGB, and the focal length from its EXIF data."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as Pillow
from PIL import UnidentifiedImageError

from tracking3d.errors import InputError
from tracking3d.frames import Image
from tracking3d.video.picture_conversion import UPRIGHT, turn_upright
from tracking3d.video.source import Intrinsics

# fmt: off
SUFFIXES = frozenset((
    ".avif", ".bmp", ".gif", ".jp2", ".jpe", ".jpeg", ".jpg",
    ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp",
))
# fmt: on
"""Names that count as images in a folder."""

# Named, because Pillow also takes text, vector and video formats for images, and runs programs for some.
_FORMATS = ("PNG", "JPEG", "MPO", "BMP", "PPM", "TIFF", "GIF", "WEBP", "JPEG2000", "AVIF")

_MAKER, _MODEL = 0x010F, 0x0110
_ORIENTATION, _EXIF, _FOCAL_LENGTH_35MM, _FOCAL_LENGTH = 0x0112, 0x8769, 0xA405, 0x920A
_WIDTH, _HEIGHT, _PIXELS_A_UNIT, _UNIT = 0xA002, 0xA003, 0xA20E, 0xA210  # of the sensor, along x
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of that unit (Exif 2.32)
_DIAGONAL_35MM = math.hypot(36.0, 24.0)


def read_image(path: Path) -> Image:
    """Read an image file as ``(H, W, 3)`` uint8 RGB, upright.

    Grey, palette and CMYK become RGB, alpha is dropped, 16 bits are scaled to 8 (value / 257, rounded), and
    the EXIF orientation is applied.

    Raises:
        InputError: If the file is missing, damaged, or no image that can be shown as RGB.
    """
    try:
        with _open(path) as image:
            deep = _is_deep(image)
            image.load()  # also where OpenCV reads the pixels: only Pillow refuses truncated files
            return turn_upright(_read_deep(path) if deep else _to_rgb(image), _orientation(image))
    except UnidentifiedImageError:
        raise InputError(f"{path} is damaged, or not an image of a known format.") from None
    except Exception as error:  # decoders raise whatever a damaged file leads them to
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read as an image ({reason}).") from error


def read_exif_intrinsics(path: Path) -> tuple[Intrinsics, str] | None:
    """The pinhole camera that an image's EXIF data tell of, and in words where it came from.

    The 35 mm equivalent focal length is the one with the same *diagonal* field of view on a 36 x 24 mm frame
    (CIPA DCG-001), so ``f = f35 * diagonal in pixels / 43.27``. Without it, the focal length in mm counts with the
    sensor's resolution, for the size that the file has now, or with its size, if lensfunpy (extra ``lens``) knows the
    camera. The principal point is the centre.

    Returns:
        ``((fx, fy, cx, cy), origin)`` in pixels of the upright image, or None if the file does not tell.
    """
    try:
        with _open(path) as image:
            told = image.getexif().get_ifd(_EXIF)
            width, height = image.size
            if _orientation(image) >= 5:
                width, height = height, width
            focal_length, how = float(told.get(_FOCAL_LENGTH_35MM, 0)), "in 35 mm terms"
            f = focal_length * math.hypot(width, height) / _DIAGONAL_35MM
            if not focal_length and _FOCAL_LENGTH in told and _PIXELS_A_UNIT in told:
                focal_length, how = float(told[_FOCAL_LENGTH]), "by the sensor's resolution"
                f = focal_length * float(told[_PIXELS_A_UNIT]) / _MILLIMETRES[told.get(_UNIT, 2)]
                # Files are made smaller, and turned, by programs that leave the sensor's figures as they were.
                taken = max(told.get(_WIDTH, 0), told.get(_HEIGHT, 0))
                f *= max(width, height) / taken if taken else 1.0
            elif not focal_length and _FOCAL_LENGTH in told and (crop := _crop_factor(image)):
                focal_length, how = float(told[_FOCAL_LENGTH]), "by the sensor's size in lensfun"
                f = focal_length * crop * math.hypot(width, height) / _DIAGONAL_35MM
    except Exception:  # None is fine here; read_image reports damaged files
        return None
    if not (0 < focal_length < math.inf and 0 < f < math.inf):
        return None
    origin = f"EXIF of {path.name}: focal length {focal_length:g} mm {how}"
    return (f, f, (width - 1) / 2, (height - 1) / 2), origin


def _crop_factor(image: Pillow.Image) -> float:
    """Diagonal of 35 mm film over that of the camera's sensor, by lensfun's data base; 0 if that does not know it."""
    try:
        import lensfunpy
    except ImportError:
        return 0.0
    maker, model = (str(image.getexif().get(tag, "")).strip(" \0") for tag in (_MAKER, _MODEL))
    found = lensfunpy.Database().find_cameras(maker, model) if maker and model else ()
    return float(found[0].crop_factor) if found else 0.0


def mode_of(path: Path) -> str:
    """Pillow's word for a file's kind of pixels, such as RGB, L (grey) or I;16 (deep grey); empty if it is damaged."""
    try:
        with _open(path) as image:
            return image.mode
    except Exception:
        return ""


def is_still_image(path: Path) -> bool:
    """Whether a file is an image without animation; a damaged one is judged by its name."""
    try:
        with _open(path) as image:
            return image.format not in ("GIF", "PNG", "WEBP") or not getattr(image, "is_animated", False)
    except Exception:
        return path.suffix.casefold() in SUFFIXES


@contextmanager
def _open(path: Path) -> Iterator[Pillow.Image]:
    Pillow.init()
    formats = [name for name in _FORMATS if name in Pillow.OPEN]  # some depend on how Pillow was built
    # Pillow warns about oddities in files that it reads all the same.
    with warnings.catch_warnings(action="ignore"), Pillow.open(path, formats=formats) as image:
        yield image


def _orientation(image: Pillow.Image) -> int:
    try:
        return int(image.getexif().get(_ORIENTATION, UPRIGHT))
    except Exception:  # damaged EXIF data are no reason to refuse the picture
        return UPRIGHT


def _to_rgb(image: Pillow.Image) -> Image:
    if image.mode in ("P", "PA"):
        image = image.convert("RGBA")  # a palette with transparency turns to RGB cleanly only by this way
    return np.asarray(image.convert("RGB"))


def _is_deep(image: Pillow.Image) -> bool:
    # Pillow names no bit depth for colour, but its decoder's arguments do ("RGB;16B"), until it has loaded.
    return image.mode.startswith(("I", "F")) or ";16" in str(getattr(image, "tile", ""))


def _read_deep(path: Path) -> Image:
    """Read more than 8 bits a channel, which Pillow cuts off (colour) or clips (grey)."""
    with silent_opencv():
        deep = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if deep is None or deep.dtype != np.uint16:
        raise ValueError(f"its pixels are {'unknown' if deep is None else deep.dtype}, not 8 or 16 bit")
    deep = deep if deep.ndim == 3 else deep[..., None]
    blue_green_red = deep[..., [0, 0, 0]] if deep.shape[2] < 3 else deep[..., :3]
    return ((blue_green_red[..., ::-1].astype(np.uint32) + 128) // 257).astype(np.uint8)


@contextmanager
def silent_opencv() -> Iterator[None]:
    """Print nothing that OpenCV logs inside the ``with`` block, then set its log level back."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
