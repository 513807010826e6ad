"""The video writer: what goes in comes out, whatever happens in between."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from tracking3d.errors import OutputError
from tracking3d.frames import Image
from tracking3d.video import VideoWriter, open_source, writer

pytestmark = pytest.mark.usefixtures("as_users_see_it")


def colour_chart(height: int = 90, width: int = 120) -> Image:
    """Smooth ramps with four patches of pure colour."""
    y, x = np.mgrid[0:height, 0:width]
    chart = np.stack([x * 255 // width, y * 255 // height, np.full_like(x, 128)], axis=2).astype(np.uint8)
    for position, colour in enumerate([(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)]):
        chart[20:60, 10 + 25 * position : 30 + 25 * position] = colour
    return chart


def noise(seed: int, height: int = 96, width: int = 128) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize("encoder", ["libx264", "mpeg4"])
def test_colours_survive_the_round_trip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoder: str
) -> None:
    if encoder not in av.codecs_available:
        pytest.skip(f"this FFmpeg has no {encoder}")
    monkeypatch.setattr(writer, "ENCODERS", ("of another world", encoder))
    chart = colour_chart()
    with VideoWriter(tmp_path / "out.mp4", 25.0, (90, 120)) as video:
        for _ in range(12):
            video.write(chart)
    source = open_source(tmp_path / "out.mp4")
    frames = list(source)
    assert (len(frames), source.fps) == (12, 25.0)
    assert [frame.time for frame in frames] == pytest.approx([index / 25 for index in range(12)])
    assert np.abs(frames[-1].image.astype(int) - chart).mean() < 4
    for position in range(4):
        patch = (40, 20 + 25 * position)
        assert np.abs(frames[-1].image[patch].astype(int) - chart[patch]).max() < 12


def test_it_plays_in_browsers(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4", 25.0, (90, 120)) as video:
        video.write(colour_chart())
    data = (tmp_path / "out.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # playable before it is loaded as a whole
    with av.open(str(tmp_path / "out.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")


@pytest.mark.parametrize(
    ("size", "padded"), [((91, 121), (92, 122)), ((90, 121), (90, 122)), ((1, 1), (2, 2))]
)
def test_odd_sizes_are_padded_to_even(tmp_path: Path, size: tuple[int, int], padded: tuple[int, int]) -> None:
    chart = colour_chart(*size)
    with VideoWriter(tmp_path / "odd.mp4", 25.0, size) as video:
        video.write(chart)
    frame = next(iter(open_source(tmp_path / "odd.mp4")))
    assert frame.size == padded
    assert np.abs(frame.image[: size[0], : size[1]].astype(int) - chart).mean() < 6


@pytest.mark.parametrize("fps", [0.5, 23.976, 29.97, 30.0, 60000 / 1001, 240.0])
def test_frame_rates_are_kept(tmp_path: Path, fps: float) -> None:
    with VideoWriter(tmp_path / "out.mp4", fps, (16, 16)) as video:
        for _ in range(3):
            video.write(np.zeros((16, 16, 3), np.uint8))
    assert open_source(tmp_path / "out.mp4").fps == pytest.approx(fps, rel=1e-4)


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_an_interrupted_video_plays_with_the_frames_so_far(
    tmp_path: Path, interruption: type[BaseException]
) -> None:
    with pytest.raises(interruption), VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)) as video:
        for index in range(20):
            if index == 7:
                raise interruption
            video.write(noise(index))
    assert len(list(open_source(tmp_path / "out.mp4"))) == 7


def test_without_a_frame_there_is_no_file(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)):
        pass
    assert not (tmp_path / "out.mp4").exists()


def test_closing_twice_is_closing_once(tmp_path: Path) -> None:
    video = VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128))
    video.write(noise(0))
    video.close()
    video.close()
    assert len(list(open_source(tmp_path / "out.mp4"))) == 1


def test_an_existing_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "out.mp4").write_bytes(b"old" * 100_000)
    with VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)) as video:
        video.write(noise(0))
    assert b"oldold" not in (tmp_path / "out.mp4").read_bytes()


@pytest.mark.parametrize("path", ["missing/out.mp4", ".", "file/out.mp4"])
def test_a_place_that_cannot_be_written_is_an_output_error(tmp_path: Path, path: str) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OutputError, match="cannot be written"):
        VideoWriter(tmp_path / path, 10.0, (96, 128))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95])
@pytest.mark.parametrize("frames", [1, 5, 60])
def test_a_full_disk_is_an_output_error_never_a_crash(tmp_path: Path, share: float, frames: int) -> None:
    resource = pytest.importorskip("resource")  # a limit on the size of files stands in for a full disk

    def write(path: Path) -> None:
        with VideoWriter(path, 10.0, (96, 128)) as video:
            for index in range(frames):
                video.write(noise(index))

    write(tmp_path / "whole.mp4")
    room = int(share * (tmp_path / "whole.mp4").stat().st_size)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        with pytest.raises(OutputError, match=r"out\.mp4 cannot be written"):
            write(tmp_path / "out.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_frames_of_another_size_are_refused(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)) as video:
        video.write(noise(0))
        with pytest.raises(ValueError, match=r"\(10, 10, 3\)"):
            video.write(noise(1, 10, 10))
        video.write(noise(2))
    assert len(list(open_source(tmp_path / "out.mp4"))) == 2


@pytest.mark.parametrize("fps", [0, -1, float("nan"), float("inf")])
def test_a_frame_rate_that_is_none_is_refused(tmp_path: Path, fps: float) -> None:
    with pytest.raises(ValueError, match="fps"):
        VideoWriter(tmp_path / "out.mp4", fps, (96, 128))


def test_encoders_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)) as video:
        video.write(noise(0))
    assert capfd.readouterr() == ("", "")


def test_a_video_can_be_watched_while_it_is_written(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)) as video:
        for index in range(6):
            video.write(noise(index))
            if index:  # a frame is there as soon as it is known how long it is shown: when the next one comes
                assert len(list(open_source(tmp_path / "out.mp4"))) == index


def test_a_finished_video_has_an_index_of_all_frames(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)) as video:
        for index in range(40):
            video.write(noise(index))
        assert b"moof" in (tmp_path / "out.mp4").read_bytes()
    assert b"moof" not in (tmp_path / "out.mp4").read_bytes()
    with av.open(str(tmp_path / "out.mp4")) as container:
        [stream] = container.streams.video
        assert (stream.frames, container.duration) == (40, 4_000_000)
    assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]


def test_a_video_whose_index_cannot_be_written_plays_as_it_is(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4", 10.0, (96, 128)) as video:
        video.write(noise(0))
        (tmp_path / ".out.mp4.part").mkdir()
    assert len(list(open_source(tmp_path / "out.mp4"))) == 1
