"""Opening a frame source from a path, address or camera number."""

from __future__ import annotations

import glob
import logging
import ssl
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import count as counting
from numbers import Real
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlsplit

import av
import av.error
import cv2
from av.container import InputContainer
from av.error import FFmpegError

from tracking3d.errors import InputError, argument
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.video.addresses import SCHEMES, check_source_name, scheme_of, without_password
from tracking3d.video.array_source import ArraySource
from tracking3d.video.image_file import is_still_image, silent_opencv
from tracking3d.video.image_sequence import ImageSequence
from tracking3d.video.latest_frames import newest
from tracking3d.video.picture_conversion import PictureConverter
from tracking3d.video.source import EVERY_FRAME, FrameSource, Intrinsics, check_frames, parse_selection
from tracking3d.video.video_decoding import decode_pictures, deinterlace
from tracking3d.video.video_file import VideoFile, describe_video, frame_of, video_stream


def open_source(
    source: str | Path | Iterable[Image], frames: str | None = None, fps: float | None = None
) -> FrameSource:
    """Open a video file, a folder or pattern of images, a camera, a video by its address, or any iterable of arrays.

    Args:
        source: A path; a pattern such as ``"shots/*.png"`` (``**`` for all subfolders); the number of a
            camera, such as ``"0"``; an address that begins with http, https, rtsp or rtsps; or an iterable of
            ``(H, W, 3)`` uint8 RGB arrays. A text that exists as a path is taken as a path.
        frames: ``START:STOP:STEP`` to select frames (see `parse_selection`); frames keep the source's index.
        fps: Frames per second of images or arrays, which have no times of their own.

    Raises:
        InputError: If there is nothing that can be read as frames, the selection is bad or empty, or ``fps`` is given
            for a source that has times of its own.
    """
    selection, fps = parse_selection(frames), validate_fps(fps)
    if isinstance(source, str | Path):
        opened = _open_path(str(source), selection)
        if fps is None:
            return opened
        if not isinstance(opened, ImageSequence):
            raise InputError(f"{opened.name} has its own time stamps; {FPS} is for images only.")
        return replace(opened, rate=fps)
    if isinstance(source, Iterable):
        return ArraySource(source, selection, rate=fps)
    raise InputError(
        f"A {type(source).__name__} is not a source of frames; give a path or an iterable of RGB arrays."
    )


def without_repeats(source: FrameSource, used: Iterable[int]) -> FrameSource:
    """The same file or images, of which pictures that repeat the one before to the bit are given as skipped.

    Args:
        source: Any source; a live one, and arrays, stay as they are.
        used: Indices of frames that are given all the same, since a prompt is for them.
    """
    if isinstance(source, ImageSequence | VideoFile):
        return replace(source, distinct=frozenset(used))
    return source


def _open_path(name: str, selection: range) -> FrameSource:
    check_source_name(name)
    path = Path(name).expanduser()
    try:
        if path.is_dir():
            return ImageSequence.open(name, list(path.iterdir()), selection)
        if path.exists():
            return _open_file(name, path, selection)
    except (OSError, ValueError) as error:  # no permission; a name that no file can have
        raise InputError(f"{name} cannot be opened: {getattr(error, 'strerror', None) or error}.") from error
    if name.isascii() and name.isdigit():
        return LiveCamera.open(int(name), selection)
    if scheme_of(name) in SCHEMES:
        return open_stream(name, selection)
    found = glob.iglob(str(path), recursive=True)  # noqa: PTH207 (Path.glob takes no absolute pattern)
    return ImageSequence.open(name, map(Path, found), selection, chosen=True)


def _open_file(name: str, path: Path, selection: range) -> VideoFile:
    if path.stat().st_size == 0:
        raise InputError(f"{name} is empty; give a video file or a folder of images.")
    if is_still_image(path):
        raise InputError(f"{name} is a single image; give its folder, or a video.")
    return VideoFile.open(name, path, selection)


@dataclass(frozen=True, eq=False)
class LiveCamera:
    """A camera by its OpenCV index; it goes on until the selection ends or the camera stops.

    Frames that come while the one before is still worked on are dropped, see `tracking3d.video.latest_frames`.

    See `tracking3d.video.source.FrameSource` for the attributes. Times are seconds since the first frame.
    """

    number: int
    selection: range
    fps: float | None
    count: int | None = None
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    repeatable: bool = False
    live: bool = True

    @classmethod
    def open(cls, number: int, selection: range = EVERY_FRAME) -> LiveCamera:
        """Check that the camera is there and ask it for its frame rate.

        Raises:
            InputError: If the camera cannot be opened.
        """
        camera = _open(number)
        rate = camera.get(cv2.CAP_PROP_FPS)
        camera.release()
        return cls(number, selection, rate / selection.step if rate > 0 else None)

    @property
    def name(self) -> str:
        """``"camera 0"``."""
        return f"camera {self.number}"

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Open the camera and give the newest frame whenever one is asked for, those dropped as `SkippedFrame`."""
        return check_frames(newest(self._frames()), self.name)

    def _frames(self) -> Iterator[Frame]:
        camera = _open(self.number)
        start = None
        try:
            for index in counting():
                if index >= self.selection.stop or not camera.grab():
                    return
                now = time.monotonic()
                start = now if start is None else start
                if index in self.selection:
                    decoded, image = camera.retrieve()
                    if not decoded:
                        return
                    rgb = cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
                    yield Frame(index, rgb, now - start, f"frame {index}")
        finally:
            camera.release()


def _open(number: int) -> cv2.VideoCapture:
    with silent_opencv():
        camera = cv2.VideoCapture(number)
    if not camera.isOpened():
        raise InputError(
            f"Camera {number} cannot be opened; check that it is connected and not in use, or give an "
            "existing file or folder."
        )
    return camera


# Videos by address: files on a web server and live streams over HTTP(S) and RTSP(S), through FFmpeg.
#
# A file (whose length the server tells) is read like one on disk; if the connection breaks off, it is taken up again
# where it was. A stream gives its newest frame, as a camera does; if it breaks off it is asked for again, a few times.
# Nothing but these protocols and the common video formats is followed, whatever an address leads to.

OPENING, READING = 10.0, 10.0
"""Timeouts in seconds: for the first data of a server, and between two packets."""
TRIES = 3
"""Number of consecutive attempts to reconnect before the video counts as ended."""
FORGOTTEN = 600.0
"""Seconds after which an end of the stream no longer counts (chosen). Its server may start it again each time."""
PAUSE = 1.0
"""Seconds before the first attempt; the wait doubles before each further one."""

_PROTOCOLS = {
    "http": "http,https,tcp,tls,httpproxy,crypto",
    "https": "http,https,tcp,tls,httpproxy,crypto",
    "rtsp": "rtsp,rtp,tcp,udp",
    "rtsps": "rtsps,rtsp,rtp,tcp,udp,tls",
}
# Named, since FFmpeg also takes playlists of local files, lists of captions and pictures for videos.
_FORMATS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,flv,mpegts,mpeg,mpegvideo,mpjpeg,mjpeg,hls,ogg,asf,m4v,h264,hevc,ivf,"
    "nut,mxf,rtsp,sdp"
)
_log = logging.getLogger(__name__)


def open_stream(address: str, selection: range = EVERY_FRAME) -> NetworkFile | LiveStream:
    """Open a video by its address.

    Args:
        address: Beginning with one of `tracking3d.video.addresses.SCHEMES`.
        selection: Wanted frame indices.

    Raises:
        InputError: If there is no video to be had.
    """
    name, scheme = without_password(address), scheme_of(address)
    try:
        host = urlsplit(address).hostname
    except ValueError:
        host = None
    if not host:
        raise InputError(f"{name} contains no server; write it as {scheme}://server/path.")
    with _open_stream(name, address) as container:
        found = describe_video(container, name, Path(address), selection)
        if scheme in ("http", "https") and found.count is not None:
            return NetworkFile(**vars(found), address=address)
    return LiveStream(name, address, selection, found.fps, notes=found.notes)


@dataclass(frozen=True, eq=False)
class NetworkFile(VideoFile):
    """A file on a web server, read as often as it is gone through."""

    address: str = ""  # with what it takes to be let in

    def container(self) -> InputContainer:
        """See `VideoFile.container`."""
        return _open_stream(self.name, self.address)


@dataclass(frozen=True, eq=False)
class LiveStream:
    """A stream that goes on; frames that come while the one before is still worked on are dropped.

    See `tracking3d.video.source.FrameSource` for the attributes. Times are seconds since the first frame, as they came.
    """

    name: str
    address: str
    selection: range
    fps: float | None
    count: int | None = None
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    repeatable: bool = False
    live: bool = True
    notes: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Open the stream and give the newest frame whenever one is asked for, those dropped as `SkippedFrame`."""
        return check_frames(newest(self._frames()), self.name)

    def _frames(self) -> Iterator[Frame | SkippedFrame]:
        indices, start, failed, ends = counting(), None, 0, list[float]()
        while True:
            try:
                for picture in self._pictures():
                    index, now, failed = next(indices), time.monotonic(), 0
                    if index >= self.selection.stop:
                        return
                    start = now if start is None else start
                    if index not in self.selection:
                        continue
                    if isinstance(picture, str):
                        yield SkippedFrame(index, f"frame {index}: {picture}")
                    else:
                        yield frame_of(index, picture[0], now - start, picture[1])
                reason, now = "it ended", time.monotonic()
                ends = [*(end for end in ends if now - end < FORGOTTEN), now]
            except InputError as error:
                if start is None:
                    raise
                reason = str(error)
            failed += 1
            if len(ends) > TRIES:
                _log.warning(
                    "%s ended %d times; the run ends with the frames received.", self.name, len(ends)
                )
                return
            if failed > TRIES:
                _log.warning(
                    "%s could not be reconnected after %d attempts; the run ends with the frames received.",
                    self.name,
                    TRIES,
                )
                return
            pause = PAUSE * 2 ** (failed - 1)
            _log.warning(
                "%s was lost (%s); trying again in %g s (%d of %d).", self.name, reason, pause, failed, TRIES
            )
            time.sleep(pause)

    def _pictures(self) -> Iterator[tuple[av.VideoFrame, PictureConverter] | str]:
        with _open_stream(self.name, self.address) as container:
            stream, convert = video_stream(container), PictureConverter()
            if stream is None:
                raise InputError(f"{self.name} no longer contains a video.")
            for picture in deinterlace(decode_pictures(container, stream)):
                yield picture if isinstance(picture, str) else (picture, convert)


def _open_stream(name: str, address: str) -> InputContainer:
    scheme = scheme_of(address) or ""
    options = {"protocol_whitelist": _PROTOCOLS[scheme], "format_whitelist": _FORMATS}
    if scheme.startswith("http"):
        # What FFmpeg does by itself in the middle of a file, which it can go on with where it was.
        options |= {
            "reconnect": "1",
            "reconnect_on_network_error": "0",
            "reconnect_max_retries": str(TRIES),
            "reconnect_delay_max": str(int(4 * PAUSE)),
        }
    else:
        options |= {"rtsp_transport": "tcp"}
    if scheme in ("https", "rtsps"):
        options |= {"tls_verify": "1"}
        if authorities := ssl.get_default_verify_paths().cafile:
            options |= {"ca_file": authorities}
    try:
        return av.open(address, options=options, timeout=(OPENING, READING), metadata_errors="ignore")
    except (FFmpegError, OSError, ValueError) as error:
        late = isinstance(error, av.error.ExitError)  # what the time-out ends with
        reason = "no response" if late else getattr(error, "strerror", None) or error
        raise InputError(
            f"{name} cannot be opened ({reason}); check the address and that the server responds within "
            f"{OPENING:g} seconds."
        ) from error


FPS = argument("fps=", "--fps")
"""Its name in messages."""
LEAST_FPS, MOST_FPS = 0.001, 100_000.0
"""Images per second: from one in a quarter of an hour to the fastest cameras."""


def validate_fps(fps: Any) -> float | None:
    """The rate as a number; None if none is given.

    Raises:
        InputError: It is not a rate.
    """
    if fps is None:
        return None
    number = isinstance(fps, Real) and not isinstance(fps, bool)
    if not number or not LEAST_FPS <= fps <= MOST_FPS:
        raise InputError(
            f"{FPS} {fps!r:.40} is not a frame rate; give images per second from {LEAST_FPS:g} to {MOST_FPS:g}."
        )
    return float(fps)
