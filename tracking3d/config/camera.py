"""The camera that a configuration gives, and the size of the object: what lengths are measured by."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any

from tracking3d.config.explain import a_kind
from tracking3d.config.models import LARGEST_OBJECT, CameraConfig, PipelineConfig
from tracking3d.errors import InputError, argument
from tracking3d.geometry.calibration.camera_files import CalibratedCamera, as_coefficients, read_camera
from tracking3d.geometry.camera import DEFAULT_FIELD_OF_VIEW, DEFAULT_ORIGIN, Camera
from tracking3d.geometry.lens import Lens

DISTORTION = argument("camera.distortion", "--distortion")
"""Name of the lens coefficients in messages."""

GIVEN = "given intrinsics"
"""Origin of a camera whose intrinsics the user gave."""

USUAL_ANGLES = (3.0, 110.0)
"""Range of plausible fields of view in degrees; a pinhole camera outside it is probably a mistake."""

_ALL = 0.99  # share of the image kept, above which no warning is needed

_log = logging.getLogger(__name__)


def choose_camera(
    config: CameraConfig,
    width: int,
    height: int,
    known: tuple[float, float, float, float] | None = None,
    known_origin: str = "",
) -> Camera:
    """The camera from the best information: file, given intrinsics, given field of view, the source's own, 45 degrees.

    With distortion it is the pinhole camera of the undistorted images, and has its ``lens``.

    Raises:
        InputError: The given camera cannot belong to images of that size. If the source's own intrinsics cannot, they
            are ignored with a warning in the log.
    """
    if config.file is not None:
        return _measured_camera(read_camera(config.file), width, height)
    camera = _pinhole(config, width, height, known, known_origin)
    coefficients = parse_distortion(config)
    if not coefficients:
        return camera
    if camera.assumed:
        raise InputError(
            f"{DISTORTION} needs the focal lengths that it was calibrated with; give "
            f"{argument('camera.intrinsics', '--intrinsics FX,FY,CX,CY')} too, or a camera file with both."
        )
    taken = CalibratedCamera(
        (camera.fx, camera.fy, camera.cx, camera.cy),
        config.distortion_model,
        coefficients,
        None,
        camera.origin,
    )
    return _measured_camera(taken, width, height)


def parse_distortion(config: CameraConfig) -> tuple[float, ...]:
    """The distortion coefficients, as many as their model has; none if there is no distortion.

    Raises:
        InputError: There are too many.
    """
    return as_coefficients(config.distortion_model, config.distortion or (), DISTORTION)


def _measured_camera(taken: CalibratedCamera, width: int, height: int) -> Camera:
    """The pinhole camera of the undistorted images of a calibrated camera.

    Raises:
        InputError: The camera cannot belong to images of that size.
    """
    fits = taken.for_frames(width, height)
    camera = Camera(*fits.intrinsics, width, height, fits.origin)
    _check(camera)
    if not fits.coefficients:
        return camera
    lens = Lens.of(fits.model, fits.coefficients, fits.intrinsics, width, height)
    origin = f"{fits.origin}, without the distortion of its lens ({fits.model})"
    return Camera(*lens.pinhole, width, height, origin, lens=lens)


def _pinhole(
    config: CameraConfig,
    width: int,
    height: int,
    known: tuple[float, float, float, float] | None,
    known_origin: str,
) -> Camera:
    """The camera without its lens."""
    if config.intrinsics is not None:
        camera = Camera(*config.intrinsics, width, height, GIVEN)
        _check(camera)
        return camera
    if config.fov is not None:
        return Camera.from_fov(width, height, config.fov, f"given field of view of {config.fov:g} degrees")
    if known is not None:
        camera = Camera(*known, width, height, known_origin)
        if _usual(camera):
            return camera
        _log.warning(
            "%s according to the %s, which is implausible; they are ignored.",
            _described(camera),
            known_origin,
        )
    origin = DEFAULT_ORIGIN
    return replace(Camera.from_fov(width, height, DEFAULT_FIELD_OF_VIEW, origin), assumed=True)


def warn_of_unlikely(camera: Camera) -> None:
    """Log a warning if given intrinsics are implausible for that image size, or a wide lens loses part of the image."""
    if camera.lens is not None and (kept := camera.lens.kept) < _ALL:
        _log.warning(
            "The lens is so wide that the pinhole camera does not see the outermost %.0f %% of the image; the object "
            "cannot be tracked there.",
            100 * (1 - kept),
        )
    if not camera.origin.startswith(GIVEN):
        return
    inside = 0 <= camera.cx < camera.width and 0 <= camera.cy < camera.height
    if not _usual(camera):
        _log.warning(
            "%s, which is implausible; check that they belong to images of that size.", _described(camera)
        )
    elif not inside:
        _log.warning(
            "%s, and their principal point %g, %g lies outside the image.",
            _described(camera),
            camera.cx,
            camera.cy,
        )


def _usual(camera: Camera) -> bool:
    least, most = USUAL_ANGLES
    return all(least <= angle <= most for angle in _angles(camera))


def _check(camera: Camera) -> None:
    if not all(1 <= angle <= 170 for angle in _angles(camera)):
        raise InputError(
            f"{_described(camera)}, which is impossible; camera.intrinsics is fx, fy, cx, cy in pixels of these images."
        )
    if not (
        -camera.width <= camera.cx <= 2 * camera.width and -camera.height <= camera.cy <= 2 * camera.height
    ):
        raise InputError(
            f"{_described(camera)}, but their principal point {camera.cx:g}, {camera.cy:g} lies far outside; "
            "camera.intrinsics is fx, fy, cx, cy in pixels of these images."
        )


def _angles(camera: Camera) -> tuple[float, float]:
    """Horizontal and vertical field of view in degrees, from the focal lengths alone."""
    horizontal = 2 * math.atan2(camera.width / 2, camera.fx)
    return math.degrees(horizontal), math.degrees(2 * math.atan2(camera.height / 2, camera.fy))


def _described(camera: Camera) -> str:
    given = ",".join(f"{value:g}" for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    horizontal, vertical = _angles(camera)
    return (
        f"The intrinsics {given} give images of {camera.width} x {camera.height} pixels a field of view of "
        f"{horizontal:.3g} x {vertical:.3g} degrees"
    )


_SIZE = argument("object_size=", "--object-size")


def check_object_size(metres: Any) -> float | None:
    """``metres``, if it can be the length of an object or is None.

    Raises:
        InputError: It cannot.
    """
    if metres is None:
        return None
    if isinstance(metres, bool) or not isinstance(metres, int | float):
        raise InputError(f"{_SIZE} is {a_kind(metres)}; give a number of metres above 0.")
    if not 0 < metres <= LARGEST_OBJECT:
        raise InputError(
            f"{_SIZE} is {metres:g}; give a number of metres above 0 and not above {LARGEST_OBJECT:,.0f}."
        )
    return float(metres)


def set_object_size(config: PipelineConfig, metres: Any) -> PipelineConfig:
    """The configuration with the length of the object; the same if ``metres`` is None.

    Raises:
        InputError: It is no length, or the object is known and has a unit of its own.
    """
    if check_object_size(metres) is None:
        return config
    if config.object.model is not None:
        raise InputError(
            f"A known object has its own unit; leave out {_SIZE}, or {argument('object=', '--object')}."
        )
    return config.model_copy(update={"object": config.object.model_copy(update={"size": float(metres)})})
