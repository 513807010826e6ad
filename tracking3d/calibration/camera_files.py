"""Camera files of other programs: OpenCV's and ROS's YAML, Kalibr's camchain, COLMAP's ``cameras.txt``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from tracking3d.calibration.calibrated_camera import CalibratedCamera
from tracking3d.calibration.colmap_cameras import colmap_cameras
from tracking3d.calibration.yaml_cameras import yaml_cameras
from tracking3d.errors import InputError

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
