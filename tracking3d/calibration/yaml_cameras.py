"""Cameras of OpenCV's and ROS's YAML files, and of Kalibr's camchains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from tracking3d.calibration.calibrated_camera import CalibratedCamera, validate_camera
from tracking3d.errors import InputError
from tracking3d.geometry.lens import Model

_DEEPEST = 20


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, which takes OpenCV's matrices for the mappings that they are."""


def _matrix_mapping(loader: yaml.SafeLoader, node: Any) -> dict[Any, Any]:
    mapping: dict[Any, Any] = loader.construct_mapping(node, deep=True)
    return mapping


for _tag in ("tag:yaml.org,2002:opencv-matrix", "!opencv-matrix"):
    _Loader.add_constructor(_tag, _matrix_mapping)


def yaml_cameras(text: str, path: Path) -> dict[str, Callable[[], CalibratedCamera]]:
    """The cameras of a file's text, by their names; one of OpenCV or ROS by the file's.

    Raises:
        InputError: If it is no YAML, or holds no camera.
    """
    # OpenCV writes a directive that YAML does not know.
    lines = text.splitlines()
    if lines and lines[0].startswith("%YAML"):
        text = "\n".join(lines[1:])
    try:
        _check_events(text)
        content = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"The camera file {path} is not valid YAML: {problem}.") from error
    if not isinstance(content, dict):
        raise InputError(f"The camera file {path} holds no camera; {_WANTED}.")
    kalibr = {
        str(name): one for name, one in content.items() if isinstance(one, dict) and "intrinsics" in one
    }
    if kalibr:
        return {name: lambda one=one: _kalibr(one, path) for name, one in kalibr.items()}  # type: ignore[misc]
    return {path.stem: lambda: _opencv(content, path)}


def _check_events(text: str) -> None:
    """Refuse what no camera file has and what takes long to read: aliases and deep nesting."""
    depth = 0
    for event in yaml.parse(text, _Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST:
            raise yaml.YAMLError("it uses aliases" if depth <= _DEEPEST else "it is nested too deeply")


_WANTED = (
    "give a YAML file with camera_matrix and distortion_coefficients as OpenCV and ROS write them, a camchain of "
    "Kalibr, or COLMAP's cameras.txt"
)
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "intrinsic_matrix")
_COEFFICIENTS = (
    "distortion_coefficients",
    "distCoeffs",
    "dist_coeffs",
    "Distortion_Coefficients",
    "D",
    "distortion",
)
_SIZES = (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height"))
_FISHEYES = ("fisheye", "equidistant", "equi", "kannala_brandt4")
_PLAIN = ("plumb_bob", "rational_polynomial", "radtan", "opencv", "none", "")


def _opencv(content: Mapping[Any, Any], path: Path) -> CalibratedCamera:
    matrix = next((content[key] for key in _MATRIX if key in content), None)
    if matrix is None:
        raise InputError(f"The camera file {path} holds no camera_matrix; {_WANTED}.")
    K = _numbers(matrix, path, "camera_matrix")
    if len(K) != 9:
        raise InputError(f"The camera_matrix of {path} has {len(K)} numbers instead of 9; restore the file.")
    k = _numbers(
        next((content[key] for key in _COEFFICIENTS if key in content), []), path, "distortion_coefficients"
    )
    size = None
    for across, down in _SIZES:
        if across in content and down in content:
            size = _whole(content[across], path), _whole(content[down], path)
    named = content.get("distortion_model", content.get("camera_model", ""))
    fisheye = str(named).casefold() in _FISHEYES or bool(content.get("fisheye_model"))
    if not fisheye and str(named).casefold() not in (*_PLAIN, "pinhole"):
        raise InputError(
            f"{path} has a distortion of the unknown model {named}; known models are plumb_bob, "
            "rational_polynomial and fisheye (equidistant)."
        )
    camera = CalibratedCamera(
        (K[0], K[4], K[2], K[5]), "fisheye" if fisheye else "radtan", k, size, path.name
    )
    return validate_camera(camera, path)


def _kalibr(content: Mapping[str, Any], path: Path) -> CalibratedCamera:
    """One camera of a camchain, https://github.com/ethz-asl/kalibr/wiki/yaml-formats."""
    kind, lens = content.get("camera_model", "pinhole"), content.get("distortion_model", "none")
    models: dict[Any, Model] = {
        "radtan": "radtan",
        "equidistant": "fisheye",
        "equi": "fisheye",
        "none": "radtan",
    }
    if kind != "pinhole" or lens not in models:
        raise InputError(
            f"{path} has a camera of the unknown models {kind} and {lens}; known are pinhole with "
            "radtan, equidistant or none."
        )
    intrinsics = _numbers(content["intrinsics"], path, "intrinsics")
    if len(intrinsics) != 4:
        raise InputError(f"The intrinsics in {path} are not fx, fy, cx, cy; restore the file.")
    fx, fy, cx, cy = intrinsics
    k = _numbers(content.get("distortion_coeffs") or [], path, "distortion_coeffs")
    size = content.get("resolution")
    if size is not None and (not isinstance(size, list) or len(size) != 2):
        raise InputError(f"The resolution in {path} is not width and height; restore the file.")
    wide = None if size is None else (_whole(size[0], path), _whole(size[1], path))
    return validate_camera(
        CalibratedCamera((fx, fy, cx, cy), models[lens], k if lens != "none" else (), wide, path.name), path
    )


def _numbers(value: Any, path: Path, what: str) -> tuple[float, ...]:
    """The numbers of a matrix as OpenCV, ROS or plain YAML has it, row by row."""
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        rows = [row if isinstance(row, list) else [row] for row in value]
        return tuple(float(one) for row in rows for one in row)
    except (TypeError, ValueError):
        raise InputError(f"The {what} of {path} are not numbers; restore the file.") from None


def _whole(value: Any, path: Path) -> int:
    try:
        return int(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"The image size in {path} is not in whole pixels; restore the file.") from None
