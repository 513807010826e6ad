"""The camera that a configuration asks for."""

from __future__ import annotations

from dataclasses import replace

from tracking3d.config.models import CameraConfig
from tracking3d.geometry.camera import DEFAULT_FIELD_OF_VIEW, Camera


def choose_camera(
    config: CameraConfig,
    width: int,
    height: int,
    known: tuple[float, float, float, float] | None = None,
    known_origin: str = "",
) -> Camera:
    """The camera by what is known best: given intrinsics, given field of view, the source's own, 45 degrees."""
    if config.intrinsics is not None:
        return Camera(*config.intrinsics, width, height, "given intrinsics")
    if config.fov is not None:
        return Camera.from_fov(width, height, config.fov, f"given field of view of {config.fov:g} degrees")
    if known is not None:
        return Camera(*known, width, height, known_origin)
    origin = f"default field of view of {DEFAULT_FIELD_OF_VIEW:g} degrees"
    return replace(Camera.from_fov(width, height, DEFAULT_FIELD_OF_VIEW, origin), assumed=True)
