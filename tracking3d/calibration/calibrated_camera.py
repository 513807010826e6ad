"""A calibrated camera with its lens distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.geometry.lens import COUNTS, Model, Pinhole


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera from a calibration."""

    intrinsics: Pinhole  # (fx, fy, cx, cy) in pixels; (0, 0) is the centre of the top-left pixel
    model: Model = "radtan"  # formula of the distortion, see `tracking3d.geometry.lens`
    coefficients: tuple[float, ...] = ()  # its coefficients; empty if there is none
    # (width, height) in pixels of the pictures that it was measured with; None if not stated
    size: tuple[int, int] | None = None
    origin: str = "given camera"  # where it came from, in words

    def for_frames(self, width: int, height: int) -> CalibratedCamera:
        """The same camera for pictures of another size, which must have the same proportions.

        Raises:
            InputError: If they have not.
        """
        if self.size in (None, (width, height)):
            return self
        assert self.size is not None
        across, down = width / self.size[0], height / self.size[1]
        if abs(across / down - 1) > 0.01:
            raise InputError(
                f"{self.origin} is a camera of {self.size[0]} x {self.size[1]} pixels, but the frames have "
                f"{width} x {height}, another aspect ratio; calibrate the camera in the mode of the video."
            )
        fx, fy, cx, cy = self.intrinsics
        scaled = (fx * across, fy * down, (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5)
        origin = f"{self.origin}, scaled from {self.size[0]} x {self.size[1]} pixels"
        return CalibratedCamera(scaled, self.model, self.coefficients, (width, height), origin)


def as_coefficients(model: Model, values: tuple[float, ...], what: str) -> tuple[float, ...]:
    """As many coefficients as a model has; none if all are 0.

    Args:
        model: The model.
        values: At most as many as it has, in OpenCV's order; what is left out is 0.
        what: What sentences call them.

    Raises:
        InputError: If there are more.
    """
    if model == "radtan" and not any(values):
        return ()  # a fisheye without coefficients is still no pinhole camera
    count = next((count for count in COUNTS[model] if count >= len(values)), None)
    if count is None:
        raise InputError(
            f"{what} has {len(values)} numbers; the model {model} has {' or '.join(map(str, COUNTS[model]))}."
        )
    if not values:
        return ()
    return (*values, *[0.0] * (count - len(values)))


def validate_camera(camera: CalibratedCamera, path: Path) -> CalibratedCamera:
    """The camera, with as many coefficients as its model has."""
    fx, fy, *_ = camera.intrinsics
    numbers = (*camera.intrinsics, *camera.coefficients)
    if not all(map(math.isfinite, numbers)) or not min(fx, fy) > 0:
        raise InputError(
            f"The camera of {path} needs finite numbers and positive focal lengths; restore the file."
        )
    if camera.size is not None and not min(camera.size) > 0:
        raise InputError(f"The image size in {path} is not positive; restore the file.")
    coefficients = as_coefficients(camera.model, camera.coefficients, f"The distortion in {path}")
    return CalibratedCamera(camera.intrinsics, camera.model, coefficients, camera.size, camera.origin)
