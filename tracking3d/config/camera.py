"""The camera that a configuration asks for."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

from tracking3d.calibration.calibrated_camera import CalibratedCamera, as_coefficients
from tracking3d.calibration.camera_files import read_camera
from tracking3d.config.models import CameraConfig
from tracking3d.errors import InputError, argument
from tracking3d.geometry.camera import DEFAULT_FIELD_OF_VIEW, Camera
from tracking3d.geometry.lens import Lens

DISTORTION = argument("camera.distortion", "--distortion")
"""What sentences call the coefficients of a lens."""

GIVEN = "given intrinsics"
"""Where a camera comes from whose intrinsics the user gave."""

USUAL_ANGLES = (3.0, 110.0)
"""Fields of view in degrees beyond which a pinhole camera is more likely a mistake."""

_ALL = 0.99  # of a picture that is kept, from which on nothing need be said

_log = logging.getLogger(__name__)


def choose_camera(
    config: CameraConfig,
    width: int,
    height: int,
    known: tuple[float, float, float, float] | None = None,
    known_origin: str = "",
) -> Camera:
    """The camera by what is known best: a file, given intrinsics, given field of view, the source's own, 45 degrees.

    With distortion it is the pinhole camera that pictures are turned into, and has its ``lens``.

    Raises:
        InputError: If the camera that was given cannot be of images of that size. Intrinsics that the source has are
            then left aside, and the log says so.
    """
    if config.file is not None:
        return _measured_camera(read_camera(config.file), width, height)
    camera = _pinhole(config, width, height, known, known_origin)
    coefficients = parse_distortion(config)
    if not coefficients:
        return camera
    if camera.assumed:
        raise InputError(
            f"{DISTORTION} means nothing without the focal lengths that it was measured with; give "
            f"{argument('camera.intrinsics', '--intrinsics FX,FY,CX,CY')} too, or both in a camera file."
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
    """The coefficients, as many as their model has; none where there is no distortion.

    Raises:
        InputError: If there are too many.
    """
    return as_coefficients(config.distortion_model, config.distortion or (), DISTORTION)


def _measured_camera(taken: CalibratedCamera, width: int, height: int) -> Camera:
    """The pinhole camera that pictures of a measured one are turned into.

    Raises:
        InputError: If it cannot be of pictures of that size.
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
    """The camera as far as it has no lens."""
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
            "%s by the %s; that is hardly a camera's, and is left aside.", _describe(camera), known_origin
        )
    origin = f"default field of view of {DEFAULT_FIELD_OF_VIEW:g} degrees"
    return replace(Camera.from_fov(width, height, DEFAULT_FIELD_OF_VIEW, origin), assumed=True)


def warn_of_unlikely(camera: Camera) -> None:
    """Tell the log where given intrinsics are possible for images of that size, but hardly meant; and what is lost."""
    if camera.lens is not None and (kept := camera.lens.kept) < _ALL:
        _log.warning(
            "The lens is so wide that %.0f %% of the picture, its outermost part, is not seen by the pinhole camera; "
            "the object has no answer there.",
            100 * (1 - kept),
        )
    if not camera.origin.startswith(GIVEN):
        return
    inside = 0 <= camera.cx < camera.width and 0 <= camera.cy < camera.height
    if not _usual(camera):
        _log.warning(
            "%s; that is hardly a camera's, so look whether they are of images of that size.",
            _describe(camera),
        )
    elif not inside:
        _log.warning("%s, whose centre %g, %g lies outside them.", _describe(camera), camera.cx, camera.cy)


def _usual(camera: Camera) -> bool:
    least, most = USUAL_ANGLES
    return all(least <= angle <= most for angle in _angles(camera))


def _check(camera: Camera) -> None:
    if not all(1 <= angle <= 170 for angle in _angles(camera)):
        raise InputError(
            f"{_describe(camera)}; camera.intrinsics is fx, fy, cx, cy in pixels of these images."
        )
    if not (
        -camera.width <= camera.cx <= 2 * camera.width and -camera.height <= camera.cy <= 2 * camera.height
    ):
        raise InputError(
            f"{_describe(camera)}, but their centre {camera.cx:g}, {camera.cy:g} lies far outside them; "
            "camera.intrinsics is fx, fy, cx, cy in pixels of these images."
        )


def _angles(camera: Camera) -> tuple[float, float]:
    """What the focal lengths alone say of the horizontal and vertical field of view, in degrees."""
    horizontal = 2 * math.atan2(camera.width / 2, camera.fx)
    return math.degrees(horizontal), math.degrees(2 * math.atan2(camera.height / 2, camera.fy))


def _describe(camera: Camera) -> str:
    given = ",".join(f"{value:g}" for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    horizontal, vertical = _angles(camera)
    return (
        f"The intrinsics {given} give images of {camera.width} x {camera.height} pixels a field of view of "
        f"{horizontal:.3g} x {vertical:.3g} degrees"
    )
