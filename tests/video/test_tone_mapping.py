"""HDR in, sRGB out: against the standards' formulas, and through an encoder."""

from __future__ import annotations

import av
import numpy as np
import pytest

from tracking3d.video import open_source
from tracking3d.video.picture_conversion import WHITE, ToneMapping, hlg_to_scene, light_to_pq, pq_to_light

TO_2020 = np.linalg.inv(
    np.array(
        [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]]
    )
)
LUMA = np.array([0.2627, 0.6780, 0.0593])
PATCHES = np.array(
    [[60, 60, 60], [128, 128, 128], [150, 60, 40], [40, 120, 60], [50, 70, 150], [170, 160, 120]], np.uint8
)
"""sRGB colours below the knee of the roll-off."""


def light_of(srgb: np.ndarray) -> np.ndarray:
    """cd/m2 in BT.2020's primaries of sRGB shown with white at `WHITE`."""
    signal = srgb / 255
    linear = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    return WHITE * linear @ TO_2020.T


def to_hlg(light: np.ndarray) -> np.ndarray:
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = light / 1000 / ((light @ LUMA / 1000) ** (1 / 6))[..., None]
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)


SIGNALS = {"PQ": light_to_pq, "HLG": to_hlg}


def test_pq_is_that_of_the_standard():
    np.testing.assert_allclose(pq_to_light(np.array([0.0, 1.0])), [0, 10_000], atol=1e-6)
    assert light_to_pq(np.array(100.0)) == pytest.approx(0.5081, abs=1e-4)  # BT.2408, table 1
    assert light_to_pq(np.array(203.0)) == pytest.approx(0.5807, abs=1e-4)
    light = np.geomspace(0.01, 10_000, 50)
    np.testing.assert_allclose(pq_to_light(light_to_pq(light)), light, rtol=1e-9)


def test_hlg_is_that_of_the_standard():
    np.testing.assert_allclose(hlg_to_scene(np.array([0.0, 0.5, 1.0])), [0, 1 / 12, 1], atol=1e-6)


@pytest.mark.parametrize("transfer", ["PQ", "HLG"])
def test_what_is_no_brighter_than_paper_looks_as_it_did(transfer):
    signal = SIGNALS[transfer](light_of(PATCHES.astype(float)))
    shown = ToneMapping(transfer, wide=True)((signal[None] * 65535).round().astype(np.uint16))
    np.testing.assert_allclose(shown[0].astype(int), PATCHES.astype(int), atol=3)


@pytest.mark.parametrize("transfer", ["PQ", "HLG"])
def test_brighter_stays_brighter_and_ends_at_white(transfer):
    grey = np.geomspace(0.5, 1000, 40)[:, None] * np.ones(3)
    signal = SIGNALS[transfer](grey)
    shown = ToneMapping(transfer, wide=True)((signal[None] * 65535).round().astype(np.uint16))[0].astype(int)
    assert (np.ptp(shown, axis=1) <= 1).all()  # grey stays grey
    assert (np.diff(shown[:, 1]) >= 0).all() and shown[-1, 1] >= 254 and shown[0, 1] < 20
    assert 215 <= np.interp(WHITE, grey[:, 0], shown[:, 1]) <= 240


def test_wide_colours_without_hdr_are_brought_in():
    signal = np.array([[[0.5, 0.5, 0.5], [0.8, 0.3, 0.3]]])
    shown = ToneMapping("SDR", wide=True)((signal * 65535).astype(np.uint16))[0].astype(int)
    assert np.ptp(shown[0]) <= 1
    assert shown[1, 0] > 0.8 * 255 and shown[1, 1] < 0.3 * 255  # a red of BT.2020 is more than one of sRGB


@pytest.mark.parametrize(("transfer", "number"), [("PQ", 16), ("HLG", 18)])
def test_an_hdr_video_is_toned_and_says_so(tmp_path, transfer, number):
    if "libx265" not in av.codecs_available:
        pytest.skip("this FFmpeg has no encoder for 10 bits of H.265")
    signal = SIGNALS[transfer](light_of(np.repeat(np.repeat(PATCHES[None], 32, 0), 16, 1).astype(float)))
    write_10_bits(tmp_path / "hdr.mp4", signal, number)
    source = open_source(tmp_path / "hdr.mp4")
    assert source.notes == (
        f"the video is HDR ({transfer}); it was tone-mapped to sRGB (BT.2390, 1000 to 203 cd/m2)",
    )
    frames = list(source)
    assert len(frames) == 2
    shown = frames[0].image[16, 8::16].astype(int)
    np.testing.assert_allclose(shown, PATCHES.astype(int), atol=6)


def write_10_bits(path, signal, transfer):
    """``signal`` ``(H, W, 3)`` R'G'B' in [0, 1] as BT.2020's Y'CbCr of limited range.

    Without B-frames: with them x265 gives a video of two frames times that it never set, and about
    one in two hundred is refused for them.
    """
    luma = signal @ LUMA
    blue, red = (signal[..., 2] - luma) / 1.8814, (signal[..., 0] - luma) / 1.4746
    height, width = luma.shape
    with av.open(str(path), "w") as file:
        stream = file.add_stream(
            "libx265", rate=25, options={"x265-params": "log-level=none:crf=4:bframes=0"}
        )
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv444p10le"
        codec = stream.codec_context
        codec.colorspace, codec.color_range, codec.color_primaries, codec.color_trc = 9, 1, 9, transfer
        for index in range(2):
            picture = av.VideoFrame(width, height, "yuv444p10le")
            for plane, values in zip(
                picture.planes, (64 + 876 * luma, 512 + 896 * blue, 512 + 896 * red), strict=True
            ):
                rows = np.zeros((height, plane.line_size // 2), np.uint16)
                rows[:, :width] = values.round()
                plane.update(rows.tobytes())
            picture.pts = index
            file.mux(stream.encode(picture))
        file.mux(stream.encode(None))


def test_ten_bits_without_hdr_are_rounded_and_need_no_note(tmp_path):
    from sample_videos import encode_video, moving_picture

    path = encode_video(tmp_path / "deep.mkv", [moving_picture(5)] * 2, codec="ffv1", pix_fmt="gbrp10le")
    source = open_source(path)
    assert source.notes == ()
    np.testing.assert_allclose(next(iter(source)).image.astype(int), moving_picture(5).astype(int), atol=1)
