"""Cameras of COLMAP's ``cameras.txt``, https://colmap.github.io/cameras.html."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tracking3d.calibration.calibrated_camera import CalibratedCamera, validate_camera
from tracking3d.errors import InputError
from tracking3d.geometry.lens import Model

_CENTRE = 0.5
"""Coordinates of the top-left pixel in COLMAP's coordinates."""

# COLMAP: how many focal lengths, the model, and which of OpenCV's coefficients the others are.
_COLMAP: dict[str, tuple[int, Model, Callable[..., tuple[float, ...]]]] = {
    "SIMPLE_PINHOLE": (1, "radtan", lambda: ()),
    "PINHOLE": (2, "radtan", lambda: ()),
    "SIMPLE_RADIAL": (1, "radtan", lambda k: (k, 0.0, 0.0, 0.0)),
    "RADIAL": (1, "radtan", lambda k1, k2: (k1, k2, 0.0, 0.0)),
    "OPENCV": (2, "radtan", lambda k1, k2, p1, p2: (k1, k2, p1, p2)),
    "FULL_OPENCV": (2, "radtan", lambda *k: (*k[:4], *k[4:8]) if len(k) == 8 else _wrong_count()),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", lambda k: (k, 0.0, 0.0, 0.0)),
    "RADIAL_FISHEYE": (1, "fisheye", lambda k1, k2: (k1, k2, 0.0, 0.0)),
    "OPENCV_FISHEYE": (2, "fisheye", lambda k1, k2, k3, k4: (k1, k2, k3, k4)),
}


def _wrong_count() -> tuple[float, ...]:
    raise TypeError


def colmap_cameras(text: str, path: Path) -> dict[str, Callable[[], CalibratedCamera]]:
    """The cameras of the file's lines, ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]``, by their numbers."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines or any(len(line) < 5 for line in lines):
        raise InputError(
            f"{path} is not a COLMAP cameras.txt with lines CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]; give one, "
            "or a YAML file of OpenCV, ROS or Kalibr."
        )

    def camera(line: list[str]) -> CalibratedCamera:
        name = line[1]
        if name not in _COLMAP:
            raise InputError(
                f"{path} has a camera of the unknown model {name}; known models are {', '.join(_COLMAP)}."
            )
        focal, model, coefficients = _COLMAP[name]
        try:
            width, height = int(line[2]), int(line[3])
            values = [float(one) for one in line[4:]]
            fx, fy = values[0], values[focal - 1]
            cx, cy = (one - _CENTRE for one in values[focal : focal + 2])
            k = coefficients(*values[focal + 2 :])
        except (ValueError, IndexError, TypeError):
            raise InputError(
                f"The camera {line[0]} of {path} has the wrong number of parameters for the model {name}; "
                "restore the file."
            ) from None
        return validate_camera(
            CalibratedCamera((fx, fy, cx, cy), model, k, (width, height), f"{path.name}"), path
        )

    return {line[0]: lambda line=line: camera(line) for line in lines}  # type: ignore[misc]
