"""Options for the tracker, the features and the shape model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from tracking3d.cli.options.general import CAMERA, TRACKING, VIDEO, numbers
from tracking3d.errors import InputError

Tracker = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Mask tracker; `tracking3d plugins` lists them. auto takes the best one at hand.",
        show_default="auto",
        rich_help_panel=TRACKING,
    ),
]
Features = Annotated[
    str | None, typer.Option(metavar="NAME", help="Feature encoder.", rich_help_panel=TRACKING)
]
Flat = Annotated[
    bool, typer.Option("--flat", help="The object is planar, like a card.", rich_help_panel=TRACKING)
]
TrustMasks = Annotated[
    bool,
    typer.Option(
        "--trust-masks",
        help="The masks of all frames (--masks) are right, for example drawn by hand: keep them.",
        rich_help_panel=TRACKING,
    ),
]
Prototype = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|MESH",
        help="Initial shape: sphere, ellipsoid or a mesh file.",
        rich_help_panel=TRACKING,
    ),
]
FinalRefine = Annotated[
    bool | None,
    typer.Option(
        "--final-refine/--no-final-refine",
        help="After the last frame, re-estimate every frame with the final model; causal estimates are kept too.",
        show_default=False,
        rich_help_panel=TRACKING,
    ),
]
OnPluginFailure = Annotated[
    str | None,
    typer.Option(
        metavar="continue|stop",
        help="If a plug-in fails after the first frame: continue with the last mask, or stop.",
        rich_help_panel=TRACKING,
    ),
]
Seed = Annotated[
    int | None, typer.Option(metavar="N", help="Random seed of the run.", rich_help_panel=TRACKING)
]


@dataclass(frozen=True)
class TrackingOptions:
    """How the object is tracked."""

    tracker: Tracker = None
    features: Features = None
    flat: Flat = False
    trust_masks: TrustMasks = False
    prototype: Prototype = None
    final_refine: FinalRefine = None
    on_plugin_failure: OnPluginFailure = None
    seed: Seed = None

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
Fps = Annotated[
    float | None,
    typer.Option(metavar="NUMBER", help="Frame rate of an image folder or pattern.", rich_help_panel=VIDEO),
]
SkipDamaged = Annotated[
    bool,
    typer.Option(
        "--skip-damaged",
        help="If the first frame cannot be decoded, apply the prompt to the first frame that can.",
        rich_help_panel=VIDEO,
    ),
]


@dataclass(frozen=True)
class VideoOptions:
    """Which frames are read, and how."""

    frames: Frames = None
    fps: Fps = None
    skip_damaged: SkipDamaged = False


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
