"""Options that several commands share, and what their texts mean."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig

_SETTINGS = "Settings"

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE.yaml", help="Configuration file.", rich_help_panel=_SETTINGS),
]
Preset = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Settings to start from, such as paper.", rich_help_panel=_SETTINGS),
]
Quality = Annotated[
    str | None,
    typer.Option(
        metavar="draft|good|best",
        help="Tracker, window, refinement and model together.",
        rich_help_panel=_SETTINGS,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        help="Change one setting; may be repeated.",
        rich_help_panel=_SETTINGS,
    ),
]


def configure(
    file: Path | None,
    preset: str | None,
    overrides: list[str] | None,
    quality: str | None = None,
    **direct: Any,
) -> PipelineConfig:
    """The configuration, the options of its plug-ins checked too; None in ``direct`` is no setting."""
    from tracking3d.config.loading import load_config
    from tracking3d.pipeline.tracker_selection import check_tracker_options
    from tracking3d.plugins import FEATURES, check_options

    config = load_config(file, preset, overrides or (), quality=quality, **_given_options(direct))
    check_tracker_options(config)
    check_options(FEATURES, config.features)
    return config


def _given_options(values: dict[str, Any]) -> dict[str, Any]:
    """``values`` without those that are None, section by section."""
    sections = {
        key: _given_options(value) if isinstance(value, dict) else value for key, value in values.items()
    }
    return {key: value for key, value in sections.items() if value is not None and value != {}}


def camera_settings(
    fov: float | None, intrinsics: str | None, distortion: str | None, file: str | None
) -> dict[str, Any]:
    """The section ``camera`` of the configuration, by the options that say of the camera.

    Raises:
        InputError: If one cannot be read, or two say the same.
    """
    if intrinsics is not None and Path(intrinsics.partition(":")[0]).is_file():
        if file is not None:
            raise InputError("Give the camera file either as --camera or as --intrinsics, not both.")
        intrinsics, file = None, intrinsics
    camera: dict[str, Any] = {"fov": fov, "file": file}
    if file is not None:
        from tracking3d.calibration.camera_files import read_camera

        if not (fov is intrinsics is distortion is None):
            raise InputError(
                "A camera file says all of the camera; leave out --fov, --intrinsics and --distortion."
            )
        read_camera(file)  # before anything is done
    if intrinsics is not None:
        camera["intrinsics"] = numbers(intrinsics, 4, "--intrinsics", "FX,FY,CX,CY in pixels")
    if distortion is not None:
        camera |= _distortion(distortion)
    return camera


def _distortion(text: str) -> dict[str, Any]:
    from tracking3d.calibration.calibrated_camera import as_coefficients

    name, colon, values = text.rpartition(":")
    model = name.strip().casefold() if colon else "radtan"
    if model not in ("radtan", "fisheye"):
        raise InputError(f"--distortion '{text}' is of the model '{name}'; known are radtan and fisheye.")
    given = numbers(values, len(values.split(",")), "--distortion", "K1,K2,P1,P2,... or fisheye:K1,K2,K3,K4")
    as_coefficients("fisheye" if model == "fisheye" else "radtan", given, f"--distortion '{text}'")
    return {"distortion": given, "distortion_model": model}


def numbers(text: str, count: int, option: str, form: str) -> tuple[float, ...]:
    """Read ``count`` finite numbers with commas between them.

    Raises:
        InputError: Anything else, naming the ``option`` and its ``form``.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{option} '{text}' is not {count} numbers; write it as {form}.")
    return values
