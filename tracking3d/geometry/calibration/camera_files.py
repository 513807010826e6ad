"""Camera files of other programs: OpenCV's and ROS's YAML, Kalibr's camchain, COLMAP's ``cameras.txt``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tracking3d.errors import InputError
from tracking3d.geometry.lens import COUNTS, Model, Pinhole

_LONGEST = 256 << 10


def read_camera(name: str | Path) -> CalibratedCamera:
    """Read a camera file, which may hold several: ``FILE:NAME`` or ``FILE:NUMBER`` is one of them.

    Raises:
        InputError: If it is not there, none of those formats, or a camera with a lens that is not known.
    """
    path, chosen = _split_path(str(name))
    text = _text(path)
    if path.suffix.casefold() == ".txt":
        return _choose_camera(colmap_cameras(text, path), chosen, path)
    return _choose_camera(yaml_cameras(text, path), chosen, path)


def _split_path(name: str) -> tuple[Path, str | None]:
    path = Path(name).expanduser()
    file, colon, chosen = name.rpartition(":")
    if colon and file and not path.exists() and Path(file).expanduser().is_file():
        return Path(file).expanduser(), chosen
    return path, None


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(_LONGEST + 1)
        if len(content) > _LONGEST:
            raise InputError(
                f"The camera file {path} is larger than {_LONGEST >> 10} KiB; it is not a camera file."
            )
        return content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(
            f"The camera file {path} does not exist; `tracking3d calibrate` makes one."
        ) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise InputError(f"The camera file {path} cannot be read: {reason}.") from error


def _choose_camera(
    cameras: Mapping[str, Callable[[], CalibratedCamera]], chosen: str | None, path: Path
) -> CalibratedCamera:
    names = ", ".join(cameras)
    if chosen is not None and chosen not in cameras:
        raise InputError(f"{path} has no camera {chosen}; it has {names}.")
    if chosen is None and len(cameras) > 1:
        first = next(iter(cameras))
        raise InputError(f"{path} holds several cameras ({names}); choose one, as in {path}:{first}.")
    return cameras[chosen if chosen is not None else next(iter(cameras))]()


def write_camera(
    path: Path, camera: CalibratedCamera, notes: Mapping[str, float | int | str] | None = None
) -> None:
    """Write a camera as OpenCV's YAML, which `read_camera` and ``cv2.FileStorage`` read.

    Args:
        path: The file.
        camera: The camera; with its size.
        notes: More keys with plain values.
    """
    fx, fy, cx, cy = camera.intrinsics
    width, height = camera.size or (0, 0)
    lines = ["%YAML:1.0", "---", f"image_width: {width}", f"image_height: {height}"]
    lines += [f'distortion_model: "{"fisheye" if camera.model == "fisheye" else "plumb_bob"}"']
    lines += _matrix("camera_matrix", 3, 3, (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0))
    k = camera.coefficients or (0.0,) * 4
    lines += _matrix("distortion_coefficients", 1, len(k), k)
    lines += [
        f"{key}: {value!r}" if not isinstance(value, str) else f'{key}: "{value}"'
        for key, value in (notes or {}).items()
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _matrix(name: str, rows: int, columns: int, values: tuple[float, ...]) -> list[str]:
    data = ", ".join(f"{one:.12e}" for one in values)
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {data} ]",
    ]


_CENTRE = 0.5
"""Coordinates of the top-left pixel in COLMAP's coordinates."""

# COLMAP: how many focal lengths, the model, and which of OpenCV's coefficients the others are.
_COLMAP: dict[str, tuple[int, Model, Callable[..., tuple[float, ...]]]] = {
    "SIMPLE_PINHOLE": (1, "radtan", lambda: ()),
    "PINHOLE": (2, "radtan", lambda: ()),
    "SIMPLE_RADIAL": (1, "radtan", lambda k: (k, 0.0, 0.0, 0.0)),
    "RADIAL": (1, "radtan", lambda k1, k2: (k1, k2, 0.0, 0.0)),
    "OPENCV": (2, "radtan", lambda k1, k2, p1, p2: (k1, k2, p1, p2)),
    "FULL_OPENCV": (2, "radtan", lambda *k: (*k[:4], *k[4:8]) if len(k) == 8 else _wrong_count()),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", lambda k: (k, 0.0, 0.0, 0.0)),
    "RADIAL_FISHEYE": (1, "fisheye", lambda k1, k2: (k1, k2, 0.0, 0.0)),
    "OPENCV_FISHEYE": (2, "fisheye", lambda k1, k2, k3, k4: (k1, k2, k3, k4)),
}


def _wrong_count() -> tuple[float, ...]:
    raise TypeError


def colmap_cameras(text: str, path: Path) -> dict[str, Callable[[], CalibratedCamera]]:
    """The cameras of the file's lines, ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]``, by their numbers."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines or any(len(line) < 5 for line in lines):
        raise InputError(
            f"{path} is not a COLMAP cameras.txt with lines CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]; give one, "
            "or a YAML file of OpenCV, ROS or Kalibr."
        )

    def camera(line: list[str]) -> CalibratedCamera:
        name = line[1]
        if name not in _COLMAP:
            raise InputError(
                f"{path} has a camera of the unknown model {name}; known models are {', '.join(_COLMAP)}."
            )
        focal, model, coefficients = _COLMAP[name]
        try:
            width, height = int(line[2]), int(line[3])
            values = [float(one) for one in line[4:]]
            fx, fy = values[0], values[focal - 1]
            cx, cy = (one - _CENTRE for one in values[focal : focal + 2])
            k = coefficients(*values[focal + 2 :])
        except (ValueError, IndexError, TypeError):
            raise InputError(
                f"The camera {line[0]} of {path} has the wrong number of parameters for the model {name}; "
                "restore the file."
            ) from None
        return validate_camera(
            CalibratedCamera((fx, fy, cx, cy), model, k, (width, height), f"{path.name}"), path
        )

    return {line[0]: lambda line=line: camera(line) for line in lines}  # type: ignore[misc]


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
