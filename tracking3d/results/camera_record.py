"""The camera in ``run.json``: a pinhole camera, and the lens that its pictures were taken through, if there is one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tracking3d.geometry.camera import Camera
from tracking3d.geometry.lens import COUNTS, Lens


def camera_from_record(told: Mapping[str, Any]) -> Camera:
    """The camera that ``dataclasses.asdict`` made a mapping of.

    Raises:
        TypeError: If a key is missing or unknown.
        ValueError: If the lens is none that can be; says why.
    """
    lens = told.get("lens")
    return Camera(**{**told, "lens": None if lens is None else _read_lens(lens, told)})


def _read_lens(lens: Any, camera: Mapping[str, Any]) -> Lens:
    if not isinstance(lens, Mapping):
        raise ValueError(f"lens is {lens!r:.40}")
    model = lens.get("model")
    if model not in COUNTS:
        raise ValueError(f"the lens has the model {model!r:.40}")
    coefficients = _numbers(lens, "coefficients", COUNTS[model])
    picture, pinhole = (_numbers(lens, name, (4,)) for name in ("picture", "pinhole"))
    if not min(*picture[:2], *pinhole[:2]) > 0:
        raise ValueError("the lens has no focal length")
    if (lens.get("width"), lens.get("height")) != (camera.get("width"), camera.get("height")):
        raise ValueError("the lens is one of pictures of another size")
    return Lens(model, coefficients, picture, pinhole, lens["width"], lens["height"])


def _numbers(lens: Mapping[str, Any], name: str, counts: tuple[int, ...]) -> tuple[Any, ...]:
    values = lens.get(name)
    if not isinstance(values, list | tuple) or len(values) not in counts:
        raise ValueError(f"{name} of the lens is {values!r:.40}")
    if not all(isinstance(one, int | float) and math.isfinite(one) for one in values):
        raise ValueError(f"{name} of the lens is {values!r:.40}")
    return tuple(float(one) for one in values)
