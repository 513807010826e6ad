"""Every common kind of image file becomes upright 8-bit RGB."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow
from PIL import ImageOps

from tracking3d.errors import InputError
from tracking3d.video import open_source, read_image

RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
DEEP = np.random.default_rng(1).integers(0, 65536, (6, 8, 4)).astype(np.uint16)


def to_eight_bits(deep: np.ndarray) -> np.ndarray:
    return np.rint(deep / 257.0).astype(np.uint8)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tiff", "ppm"])
def test_lossless_rgb_is_read_exactly(tmp_path: Path, suffix: str) -> None:
    Pillow.fromarray(RGB).save(tmp_path / f"image.{suffix}")
    image = read_image(tmp_path / f"image.{suffix}")
    assert image.dtype == np.uint8 and image.flags.c_contiguous
    np.testing.assert_array_equal(image, RGB)


def test_grey_fills_all_three_channels(tmp_path: Path) -> None:
    Pillow.fromarray(RGB[..., 0]).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png"), np.repeat(RGB[..., :1], 3, axis=2))


def test_one_bit_is_black_and_white(tmp_path: Path) -> None:
    Pillow.fromarray(RGB[..., 0] > 127).save(tmp_path / "bits.png")
    np.testing.assert_array_equal(
        read_image(tmp_path / "bits.png")[..., 1], np.where(RGB[..., 0] > 127, 255, 0)
    )


@pytest.mark.parametrize("channels", [2, 4])
def test_alpha_is_dropped_also_where_it_is_transparent(tmp_path: Path, channels: int) -> None:
    alpha = np.zeros((6, 8, 1), np.uint8)
    colour = RGB[..., : channels - 1]
    Pillow.fromarray(np.concatenate([colour, alpha], axis=2)).save(tmp_path / "alpha.png")
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), np.broadcast_to(colour, RGB.shape))


@pytest.mark.parametrize("transparency", [None, 3, bytes([0, 128, 255])])
def test_a_palette_is_looked_up(tmp_path: Path, transparency: int | bytes | None) -> None:
    indices = (np.arange(48).reshape(6, 8) % 7).astype(np.uint8)
    palette = np.random.default_rng(2).integers(0, 256, (256, 3)).astype(np.uint8)
    image = Pillow.fromarray(indices)
    image.putpalette(palette.tobytes())
    image.save(tmp_path / "palette.png", **({} if transparency is None else {"transparency": transparency}))
    np.testing.assert_array_equal(read_image(tmp_path / "palette.png"), palette[indices])


def test_cmyk_becomes_rgb(tmp_path: Path) -> None:
    cmyk = np.zeros((16, 16, 4), np.uint8)
    cmyk[:, :8] = [0, 255, 255, 0]  # magenta and yellow ink: red
    cmyk[:, 8:, 3] = 255  # black ink
    Pillow.fromarray(cmyk, mode="CMYK").save(tmp_path / "cmyk.jpg", quality=98, subsampling=0)
    image = read_image(tmp_path / "cmyk.jpg").astype(int)
    assert np.abs(image[:, :8] - [255, 0, 0]).max() < 12
    assert image[:, 8:].max() < 12


@pytest.mark.parametrize("suffix", ["png", "tiff"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_scaled_not_cut_or_clipped(tmp_path: Path, suffix: str, channels: int) -> None:
    deep = DEEP[..., 0] if channels == 1 else DEEP[..., :channels]
    blue_first = deep if channels == 1 else deep[..., [2, 1, 0, 3][:channels]]
    assert cv2.imwrite(str(tmp_path / f"deep.{suffix}"), blue_first)
    expected = np.repeat(deep[..., None], 3, axis=2) if channels == 1 else deep[..., :3]
    np.testing.assert_array_equal(read_image(tmp_path / f"deep.{suffix}"), to_eight_bits(expected))


def test_sixteen_bit_grey_with_alpha(tmp_path: Path) -> None:
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    grey_alpha = DEEP[..., :2].astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in grey_alpha)
    header = struct.pack(">IIBBBBB", 8, 6, 16, 4, 0, 0, 0)
    png = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )
    (tmp_path / "deep.png").write_bytes(png)
    expected = np.repeat(to_eight_bits(DEEP[..., :1]), 3, axis=2)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), expected)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(tmp_path: Path, orientation: int) -> None:
    exif = Pillow.Exif()
    exif[0x0112] = orientation
    Pillow.fromarray(RGB).save(tmp_path / "turned.png", exif=exif)
    with Pillow.open(tmp_path / "turned.png") as stored:
        upright = np.asarray(ImageOps.exif_transpose(stored))
    np.testing.assert_array_equal(read_image(tmp_path / "turned.png"), upright)


def test_a_senseless_orientation_is_ignored(tmp_path: Path) -> None:
    exif = Pillow.Exif()
    exif[0x0112] = 77
    Pillow.fromarray(RGB).save(tmp_path / "odd.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "odd.png"), RGB)


def photo(path: Path, size: tuple[int, int], focal_length: float | None, orientation: int = 1) -> None:
    exif = Pillow.Exif()
    exif[0x0112] = orientation
    if focal_length is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_length
    Pillow.new("RGB", size, (90, 120, 30)).save(path, exif=exif)


def test_the_exif_focal_length_gives_the_camera(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg", (400, 300), 28)
    photo(tmp_path / "2.jpg", (400, 300), 85)

    source = open_source(tmp_path)

    # 4:3 pictures: 28 mm in 35 mm terms has the diagonal field of view of 36 x 24 mm film.
    fx, fy, cx, cy = source.intrinsics
    diagonal_view = 2 * math.atan(math.hypot(400, 300) / 2 / fx)
    assert diagonal_view == pytest.approx(2 * math.atan(math.hypot(36, 24) / 2 / 28))
    assert (fy, cx, cy) == (fx, 199.5, 149.5)
    assert "28 mm" in source.intrinsics_origin and "1.jpg" in source.intrinsics_origin
    assert open_source(tmp_path, "1:").intrinsics[0] == pytest.approx(fx * 85 / 28)


def test_a_turned_photo_has_its_principal_point_in_the_upright_picture(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg", (400, 300), 28, orientation=6)
    source = open_source(tmp_path)
    assert source.intrinsics[2:] == (149.5, 199.5)
    assert next(iter(source)).size == (400, 300)


@pytest.mark.parametrize(
    ("size", "orientation", "unit", "expected"),
    [
        ((640, 480), 1, 2, 5.40625 * 3106.8 / 25.4),
        ((320, 240), 1, 2, 5.40625 * 3106.8 / 25.4 / 2),  # made smaller
        ((480, 640), 1, 2, 5.40625 * 3106.8 / 25.4),  # turned by a program
        ((640, 480), 6, 2, 5.40625 * 3106.8 / 25.4),
        ((640, 480), 1, 3, 5.40625 * 3106.8 / 10),
    ],
)
def test_without_a_35_mm_length_the_sensor_s_resolution_counts_for_the_size_that_the_file_has_now(
    tmp_path, size, orientation, unit, expected
) -> None:
    exif = Pillow.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update(
        {0x920A: 5.40625, 0xA20E: 3106.8, 0xA20F: 3106.8, 0xA210: unit, 0xA002: 640, 0xA003: 480}
    )
    Pillow.new("RGB", size).save(tmp_path / "1.jpg", exif=exif)
    source = open_source(tmp_path)
    assert source.intrinsics[0] == source.intrinsics[1] == pytest.approx(expected, rel=1e-4)
    assert "5.40625 mm by the sensor's resolution" in source.intrinsics_origin


@pytest.mark.parametrize(("model", "known"), [("COOLPIX P60\0", True), ("COOLPIX P61", False)])
def test_without_both_a_known_camera_s_sensor_counts(tmp_path, monkeypatch, model, known) -> None:
    """By a stand-in for lensfunpy, whose data base has this camera with this crop factor."""

    class Database:
        def find_cameras(self, maker: str, model: str) -> list[SimpleNamespace]:
            return [SimpleNamespace(crop_factor=5.62)] if (maker, model) == ("NIKON", "COOLPIX P60") else []

    monkeypatch.setitem(sys.modules, "lensfunpy", SimpleNamespace(Database=Database))
    exif = Pillow.Exif()
    exif.update({0x010F: "NIKON", 0x0110: model})
    exif.get_ifd(0x8769)[0x920A] = 6.4
    Pillow.new("RGB", (400, 300)).save(tmp_path / "1.jpg", exif=exif)
    source = open_source(tmp_path)
    assert (source.intrinsics is not None) == known
    if known:
        assert source.intrinsics[0] == pytest.approx(6.4 * 5.62 * 500 / math.hypot(36, 24))
        assert "6.4 mm by the sensor's size in lensfun" in source.intrinsics_origin
    monkeypatch.setitem(sys.modules, "lensfunpy", None)  # is not installed
    assert open_source(tmp_path).intrinsics is None


@pytest.mark.parametrize("focal_length", [None, 0])
def test_without_a_focal_length_there_is_no_camera(tmp_path: Path, focal_length: float | None) -> None:
    photo(tmp_path / "1.jpg", (400, 300), focal_length)
    source = open_source(tmp_path)
    assert source.intrinsics is None
    assert source.intrinsics_origin == ""


@pytest.mark.parametrize(
    "content",
    [b"", b"no image at all", b"\x89PNG\r\n\x1a\n", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"],
)
def test_what_is_no_image_is_an_input_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.png").write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.png"):
        read_image(tmp_path / "bad.png")


@pytest.mark.parametrize("name", ["cut.png", "cut.jpg", "cut.tiff", "deep.png"])
def test_a_truncated_image_is_an_input_error(tmp_path: Path, name: str) -> None:
    noise = np.random.default_rng(3).integers(0, 65536, (40, 40, 3)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / name), noise if name == "deep.png" else (noise // 257).astype(np.uint8))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=name):
        read_image(tmp_path / name)


def test_pixels_that_are_neither_8_nor_16_bit_are_an_input_error(tmp_path: Path) -> None:
    Pillow.fromarray(np.ones((6, 8), np.float32)).save(tmp_path / "depth.tiff")
    with pytest.raises(InputError, match="float32"):
        read_image(tmp_path / "depth.tiff")


def test_a_missing_image_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.png .*No such file"):
        read_image(tmp_path / "none.png")
