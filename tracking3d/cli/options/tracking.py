"""Options for the tracker, the features and the shape model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer

from tracking3d.cli.options.general import CAMERA, TRACKING, VIDEO, KeyOption, numbers
from tracking3d.errors import InputError

Tracker = Annotated[str | None, KeyOption("tracker", "NAME", show_default="auto", rich_help_panel=TRACKING)]
Features = Annotated[str | None, KeyOption("features", "NAME", rich_help_panel=TRACKING)]


@dataclass(frozen=True)
class TrackingOptions:
    """How the object is tracked."""

    PANEL: ClassVar = TRACKING

    tracker: Tracker = None
    features: Features = None
    flat: Annotated[bool | None, KeyOption("object.flat", None, "--flat")] = None
    trust_masks: Annotated[bool | None, KeyOption("object.trust_masks", None, "--trust-masks")] = None
    prototype: Annotated[str | None, KeyOption("object.prototype", "NAME|MESH")] = None
    final_refine: Annotated[
        bool | None,
        KeyOption("solver.final_refine", None, "--final-refine/--no-final-refine", show_default=False),
    ] = None
    on_plugin_failure: Annotated[str | None, KeyOption("runtime.on_plugin_failure", "continue|stop")] = None
    seed: Annotated[int | None, KeyOption("runtime.seed", "N")] = None

    def tracker_settings(self, masks: Path | None) -> dict[str, str | int | None]:
        """The section ``tracker`` of the configuration.

        Args:
            masks: Value of ``--masks``, which selects the tracker ``precomputed``.

        Raises:
            InputError: ``--masks`` is given together with another tracker.
        """
        if masks is None:
            return {"name": self.tracker}
        if self.tracker not in (None, "precomputed", "auto"):
            raise InputError(
                f"--masks uses the tracker 'precomputed'; leave out --tracker {self.tracker} or --masks."
            )
        from tracking3d.trackers.mask_images import split_object

        path, number = split_object(masks)
        return {"name": "precomputed", "path": str(path), "object": number}


Source = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="Video file, image folder, quoted image pattern, camera number, or http(s) or rtsp(s) address.",
    ),
]
Frames = Annotated[
    str | None,
    typer.Option(
        metavar="START:STOP:STEP",
        help="Frames to read, counted from 0; STOP is not included.",
        rich_help_panel=VIDEO,
    ),
]


@dataclass(frozen=True)
class VideoOptions:
    """Which frames are read, and how."""

    PANEL: ClassVar = VIDEO

    frames: Frames = None
    fps: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Frame rate of an image folder or pattern."),
    ] = None
    skip_damaged: Annotated[
        bool,
        typer.Option(
            "--skip-damaged",
            help="If the first frame cannot be decoded, apply the prompt to the first frame that can.",
        ),
    ] = False


@dataclass(frozen=True)
class CameraOptions:
    """Intrinsics and distortion; the camera is estimated or assumed if none is given."""

    PANEL: ClassVar = CAMERA

    fov: Annotated[float | None, KeyOption("camera.fov", "DEGREES")] = None
    intrinsics: Annotated[str | None, KeyOption("camera.intrinsics", "FX,FY,CX,CY")] = None
    distortion: Annotated[
        str | None, KeyOption("camera.distortion", "K1,K2,P1,P2,...|fisheye:K1,K2,K3,K4")
    ] = None
    camera_file: Annotated[str | None, KeyOption("camera.file", "FILE", "--camera")] = None

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
            from tracking3d.geometry.calibration.camera_files import read_camera

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
    from tracking3d.geometry.calibration.camera_files import as_coefficients

    name, colon, values = text.rpartition(":")
    model = name.strip().casefold() if colon else "radtan"
    if model not in ("radtan", "fisheye"):
        raise InputError(f"--distortion '{text}' names the model '{name}'; use radtan or fisheye.")
    given = numbers(values, len(values.split(",")), "--distortion", "K1,K2,P1,P2,... or fisheye:K1,K2,K3,K4")
    as_coefficients("fisheye" if model == "fisheye" else "radtan", given, f"--distortion '{text}'")
    return {"distortion": given, "distortion_model": model}
