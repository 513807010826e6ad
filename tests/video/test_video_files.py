"""Video files: any codec, turned upright, true times, damage survived."""

from __future__ import annotations

import gc
import struct
import wave
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
from sample_videos import damage_packet, encode_video, moving_picture, shown_numbers

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video import FrameSource, open_source
from tracking3d.video.opening import without_repeats

Clip = Callable[..., Path]


def with_display_matrix(path: Path, a: int, b: int, c: int, d: int) -> Path:
    """Write a display matrix into the track header of an MP4 file (ISO/IEC 14496-12, 8.3.2)."""
    data = path.read_bytes()
    start = data.index(b"tkhd") + 4 + 40
    matrix = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data[:start] + matrix + data[start + 36 :])
    return path


CODECS = [
    ("libx264", "mp4", "yuv420p"),
    ("libx264", "mkv", "yuv420p10le"),
    ("libx264", "ts", "yuv444p"),
    ("mpeg4", "avi", "yuv420p"),
    ("mjpeg", "avi", "yuvj420p"),
    ("libvpx-vp9", "webm", "yuv420p"),
    ("ffv1", "mkv", "gbrp10le"),
    ("png", "mov", "rgb24"),
]


@pytest.mark.parametrize(("codec", "suffix", "pix_fmt"), CODECS)
def test_every_codec_gives_all_frames_in_order_and_time(
    clip: Clip, codec: str, suffix: str, pix_fmt: str
) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg cannot encode {codec}")
    source = open_source(clip(f"clip.{suffix}", codec=codec, pix_fmt=pix_fmt))
    frames = list(source)
    assert shown_numbers(frames) == list(range(30))
    assert isinstance(source, FrameSource)
    assert (source.count, source.fps, source.intrinsics) == (30, 10.0, None)
    assert all(frame.size == (64, 96) and frame.image.dtype == np.uint8 for frame in frames)
    steps = np.diff([frame.time for frame in frames])
    np.testing.assert_allclose(steps, 0.1, atol=1e-3)


def test_a_lossless_video_is_read_exactly(clip: Clip) -> None:
    for frame in open_source(clip("exact.mkv", codec="ffv1", pix_fmt="bgr0"), "::10"):
        np.testing.assert_array_equal(frame.image, moving_picture(frame.index))


def test_ten_bits_are_scaled_to_eight(clip: Clip) -> None:
    for frame in open_source(clip("deep.mkv", codec="ffv1", pix_fmt="gbrp10le"), "::10"):
        assert np.abs(frame.image.astype(int) - moving_picture(frame.index)).max() <= 1


@pytest.mark.parametrize(
    "matrix",
    [
        (1, 0, 0, 1),
        (0, 1, -1, 0),
        (-1, 0, 0, -1),
        (0, -1, 1, 0),
        (-1, 0, 0, 1),
        (1, 0, 0, -1),
        (0, 1, 1, 0),
        (0, -1, -1, 0),
    ],
)
def test_the_display_matrix_turns_and_mirrors_the_picture(
    clip: Clip, matrix: tuple[int, int, int, int]
) -> None:
    a, b, c, d = matrix
    stored = np.zeros((64, 96, 3), np.uint8)
    stored[:32, :48], stored[:32, 48:], stored[32:, :48] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    # The standard's words, pixel by pixel: (x, y) is shown at (a x + c y, b x + d y), moved into view.
    y, x = np.mgrid[0:64, 0:96]
    shown_x, shown_y = a * x + c * y, b * x + d * y
    shown_x, shown_y = shown_x - shown_x.min(), shown_y - shown_y.min()
    expected = np.zeros((shown_y.max() + 1, shown_x.max() + 1, 3), np.uint8)
    expected[shown_y, shown_x] = stored

    path = clip()
    encode_video(path, [stored] * 3)
    frame = next(iter(open_source(with_display_matrix(path, *matrix))))

    assert frame.image.shape == expected.shape
    assert np.abs(frame.image.astype(int) - expected).mean() < 6
    assert np.abs(frame.image[::16, ::16].astype(int) - expected[::16, ::16]).max() < 40


def test_a_variable_frame_rate_keeps_its_true_times(tmp_path: Path) -> None:
    milliseconds = [0, 40, 50, 400, 1000, 1010, 3000]
    images = [moving_picture(index) for index in range(len(milliseconds))]
    path = encode_video(tmp_path / "vfr.mp4", images, milliseconds=milliseconds)
    assert [frame.time for frame in open_source(path)] == pytest.approx(
        [ms / 1000 for ms in milliseconds], abs=1e-3
    )


def test_time_counts_from_the_first_frame_of_the_stream(tmp_path: Path) -> None:
    path = encode_video(tmp_path / "late.ts", [moving_picture(index) for index in range(5)])
    assert [frame.time for frame in open_source(path)] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-3)


@pytest.mark.parametrize("frames", ["0:20:5", "29:", "7:9", ":3", "::13"])
def test_selected_frames_keep_index_and_time(clip: Clip, frames: str) -> None:
    source = open_source(clip(), frames)
    selected = list(source)
    wanted = list(range(30))[slice(*[int(part) if part else None for part in frames.split(":")])]
    assert [frame.index for frame in selected] == shown_numbers(selected) == wanted
    assert source.count == len(wanted)
    assert [frame.time for frame in selected] == pytest.approx([index / 10 for index in wanted])


def test_pictures_are_let_go_as_soon_as_they_are_read(clip: Clip) -> None:
    path = clip("clip.avi", codec="mjpeg", pix_fmt="yuvj420p")  # no picture waits for another
    gc.collect()
    gc.freeze()  # what was there before is not looked through again for every picture
    gc.disable()  # otherwise pictures in reference cycles would pile up only until the next collection
    try:
        held = [
            sum(issubclass(type(item), av.VideoFrame) for item in gc.get_objects()) for _ in open_source(path)
        ]
    finally:
        gc.enable()
        gc.unfreeze()
    assert held[-1] == held[1]


def test_a_step_lowers_the_frame_rate(clip: Clip) -> None:
    assert open_source(clip(), "::5").fps == 2.0


def test_a_selection_beyond_the_end_is_an_input_error(clip: Clip) -> None:
    with pytest.raises(InputError, match="no frame in the selected range"):
        list(open_source(clip(), "30:"))


@pytest.mark.parametrize("packet", [14, 17])
@pytest.mark.parametrize(
    ("codec", "suffix", "pix_fmt"),
    [
        ("libx264", "mp4", "yuv420p"),
        ("libx264", "mkv", "yuv420p10le"),
        ("mpeg4", "mp4", "yuv420p"),
        ("mjpeg", "avi", "yuvj420p"),
        ("png", "mov", "rgb24"),
    ],
)
def test_a_damaged_frame_is_skipped_and_the_others_keep_their_index(
    clip: Clip, codec: str, suffix: str, pix_fmt: str, packet: int
) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg cannot encode {codec}")
    path = clip(f"clip.{suffix}", codec=codec, pix_fmt=pix_fmt)
    lost = damage_packet(path, packet)
    frames = list(open_source(path))
    skipped = [frame for frame in frames if isinstance(frame, SkippedFrame)]
    assert [frame.index for frame in frames] == list(range(30))
    assert [frame.index for frame in skipped] == [lost]
    assert f"frame {lost}" in skipped[0].reason
    # Frames that lean on the lost one show traces of it; by the next key frame they are right again.
    assert shown_numbers(frames)[20:] == list(range(20, 30))


def test_frames_that_a_decoder_leaves_out_silently_are_counted(clip: Clip) -> None:
    path = clip()
    damage_packet(path, 0)  # the key frame that the next nine need
    frames = list(open_source(path))
    assert [frame.index for frame in frames] == list(range(30))
    shown = shown_numbers(frames)
    assert shown[0] is None
    assert shown[10:] == list(range(10, 30))
    assert all(f"frame {frame.index}" in frame.reason for frame in frames if isinstance(frame, SkippedFrame))


def test_interlaced_video_gives_every_frame_once(clip: Clip) -> None:
    path = clip("interlaced.ts", options={"x264-params": "interlaced=1"})
    assert shown_numbers(list(open_source(path))) == list(range(30))


@pytest.mark.parametrize("suffix", ["avi", "mkv"])
def test_a_video_that_breaks_off_gives_what_it_has(clip: Clip, suffix: str) -> None:
    path = clip(f"cut.{suffix}", codec="mjpeg", pix_fmt="yuvj420p")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    frames = list(open_source(path))
    whole = [number for number in shown_numbers(frames) if number is not None]
    assert whole == list(range(len(whole)))
    assert 13 <= len(whole) <= 19
    if suffix == "avi":  # its header tells how many frames there were
        assert isinstance(frames[-1], SkippedFrame)
        assert "truncated" in frames[-1].reason


def test_frames_of_another_size_within_a_video_are_skipped(tmp_path: Path) -> None:
    wide = encode_video(tmp_path / "wide.ts", [moving_picture(index) for index in range(5)])
    tall = encode_video(tmp_path / "tall.ts", [moving_picture(index, 96, 64) for index in range(5)])
    (tmp_path / "both.ts").write_bytes(wide.read_bytes() + tall.read_bytes())
    frames = list(open_source(tmp_path / "both.ts"))
    assert shown_numbers(frames) == [0, 1, 2, 3, 4, None, None, None, None, None]
    assert "64 x 96" in frames[5].reason and "96 x 64" in frames[5].reason


def test_a_video_without_one_good_frame_is_an_input_error(clip: Clip) -> None:
    path = clip("clip.avi", codec="mjpeg", pix_fmt="yuvj420p")
    for packet in range(30):
        damage_packet(path, packet)
    with pytest.raises(InputError, match=r"clip\.avi has no frame that can be decoded"):
        list(open_source(path))


@pytest.mark.parametrize("name", ["text.mp4", "text.txt", "text.yaml", "text"])
def test_a_text_file_is_an_input_error_whatever_its_name(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("this is no video\n" * 200)
    with pytest.raises(InputError, match=f"{name}.* video"):
        open_source(tmp_path / name)


@pytest.mark.parametrize("content", [b"", b"\0" * 5000])
def test_an_empty_or_zeroed_file_is_an_input_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "clip.mp4").write_bytes(content)
    with pytest.raises(InputError, match=r"clip\.mp4"):
        open_source(tmp_path / "clip.mp4")


def test_a_truncated_video_without_its_index_is_an_input_error(clip: Clip) -> None:
    path = clip()
    data = path.read_bytes()
    assert data.index(b"moov") > len(data) // 2  # the index stands at the end, as cameras write it
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="the file is complete"):
        open_source(path)


def test_a_sound_file_is_an_input_error(tmp_path: Path) -> None:
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(16000))
    with pytest.raises(InputError, match="contains no video"):
        open_source(tmp_path / "sound.wav")


@pytest.mark.parametrize("source", ["nowhere.mp4", "nowhere/", "", " ", "no\0where"])
def test_what_does_not_exist_is_an_input_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError):
        open_source(source)


def test_a_name_with_a_colon_is_no_protocol(
    clip: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip().rename(tmp_path / "http:clip 100%d.mp4")
    monkeypatch.chdir(tmp_path)
    assert len(list(open_source("http:clip 100%d.mp4", ":2"))) == 2


def test_decoders_print_nothing(clip: Clip, capfd: pytest.CaptureFixture[str]) -> None:
    path = clip()
    for packet in (0, 12, 20):
        damage_packet(path, packet)
    capfd.readouterr()
    list(open_source(path))
    assert capfd.readouterr() == ("", "")


def test_a_real_video(shared_data: Path) -> None:
    source = open_source(shared_data / "cube_in_hand" / "full_video.mp4", "0:20:5")
    frames = list(source)
    assert source.count == 4
    assert source.fps == pytest.approx(6.0)
    assert [frame.index for frame in frames] == [0, 5, 10, 15]
    assert [frame.time for frame in frames] == pytest.approx([0, 1 / 6, 1 / 3, 1 / 2])
    assert {frame.size for frame in frames} == {(480, 640)}


def test_repeated_pictures_of_a_video_are_skipped_where_that_is_asked_for(tmp_path: Path) -> None:
    shown = [moving_picture(number) for number in (0, 0, 1, 1, 1, 0)]
    shown[4] = shown[4].copy()
    shown[4][5, 7] ^= 1  # which is another picture
    source = open_source(encode_video(tmp_path / "still.mkv", shown, codec="ffv1", pix_fmt="bgr0"))
    assert all(isinstance(frame, Frame) for frame in source)
    for used, repeats in (((), {1: 0, 3: 2}), ([3], {1: 0})):
        frames = list(without_repeats(source, used))
        assert {one.index: one.repeats for one in frames if isinstance(one, SkippedFrame)} == repeats
        assert [one.time for one in frames] == pytest.approx([index / 10 for index in range(6)])
