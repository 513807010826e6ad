"""Options for the camera and its lens."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from tracking3d.cli.options.numbers import numbers
from tracking3d.cli.options.panels import CAMERA
from tracking3d.errors import InputError

Fov = Annotated[
    float | None,
    typer.Option(metavar="DEGREES", help="Vertical field of view in degrees.", rich_help_panel=CAMERA),
]
Intrinsics = Annotated[
    str | None,
    typer.Option(
        metavar="FX,FY,CX,CY",
        help="Focal lengths and principal point, in pixels of the full frame.",
        rich_help_panel=CAMERA,
    ),
]
Distortion = Annotated[
    str | None,
    typer.Option(
        metavar="K1,K2,P1,P2,...",
        help="Lens distortion coefficients in OpenCV's order; fisheye:K1,K2,K3,K4 for a fisheye lens.",
        rich_help_panel=CAMERA,
    ),
]
CameraFile = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="FILE",
        help="Camera file with intrinsics and distortion: YAML of OpenCV, ROS or Kalibr, or COLMAP's cameras.txt.",
        rich_help_panel=CAMERA,
    ),
]


@dataclass(frozen=True)
class CameraOptions:
    """Intrinsics and distortion; the camera is estimated or assumed if none is given."""

    fov: Fov = None
    intrinsics: Intrinsics = None
    distortion: Distortion = None
    camera_file: CameraFile = None

    def settings(self) -> dict[str, Any]:
        """The section ``camera`` of the configuration.

        Raises:
            InputError: An option cannot be read, or two options contradict each other.
        """
        intrinsics, file = self.intrinsics, self.camera_file
        if intrinsics is not None and Path(intrinsics.partition(":")[0]).is_file():
            if file is not None:
                raise InputError("Give the camera file either as --camera or as --intrinsics, not both.")
            intrinsics, file = None, intrinsics
        camera: dict[str, Any] = {"fov": self.fov, "file": file}
        if file is not None:
            from tracking3d.calibration.camera_files import read_camera

            if not (self.fov is intrinsics is self.distortion is None):
                raise InputError(
                    "A camera file has all parameters of the camera; leave out --fov, --intrinsics and --distortion."
                )
            read_camera(file)  # before anything is tracked
        if intrinsics is not None:
            camera["intrinsics"] = numbers(intrinsics, 4, "--intrinsics", "FX,FY,CX,CY in pixels")
        if self.distortion is not None:
            camera |= _parse_distortion(self.distortion)
        return camera


def _parse_distortion(text: str) -> dict[str, Any]:
    from tracking3d.calibration.calibrated_camera import as_coefficients

    name, colon, values = text.rpartition(":")
    model = name.strip().casefold() if colon else "radtan"
    if model not in ("radtan", "fisheye"):
        raise InputError(f"--distortion '{text}' names the model '{name}'; use radtan or fisheye.")
    given = numbers(values, len(values.split(",")), "--distortion", "K1,K2,P1,P2,... or fisheye:K1,K2,K3,K4")
    as_coefficients("fisheye" if model == "fisheye" else "radtan", given, f"--distortion '{text}'")
    return {"distortion": given, "distortion_model": model}
