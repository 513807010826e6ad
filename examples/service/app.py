"""A web service that answers an uploaded video with the object's poses.

$ pip install 'tracking3d[service]'
$ uvicorn app:app --app-dir examples/service --host 127.0.0.1 --port 8000
$ curl --data-binary @clip.mp4 'http://127.0.0.1:8000/track?box=301,11,296,227'

What strangers send is bounded: bytes, pictures, their size, and seconds; one video at a time. A video lies in a
temporary folder of its own, under a name of ours, and is gone when the answer is. Put what knows your users (TLS, keys,
quotas) in front of it.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import anyio
from fastapi import FastAPI, HTTPException, Query, Request
from starlette.concurrency import run_in_threadpool

import tracking3d
from tracking3d.errors import Tracking3dError
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.trackers.prompts.prompt import parse_box
from tracking3d.video import open_source


@dataclass(frozen=True)
class Limits:
    """What one request may take."""

    video_bytes: int = 200_000_000
    upload_seconds: float = 60
    frames: int = 600
    pixels: int = 1920 * 1080
    seconds: float = 300


CONTAINERS = {b"ftyp": 4, b"\x1a\x45\xdf\xa3": 0, b"AVI ": 8}
"""MP4 and MOV, Matroska and WebM, AVI, and where that stands. Others, such as play lists, could name files of ours."""


def service(limits: Limits = Limits()) -> FastAPI:
    """The application."""
    app = FastAPI(title="tracking3d", version=tracking3d.__version__)
    one_at_a_time, uploads = threading.Semaphore(1), threading.Semaphore(4)

    @app.get("/health")
    def health() -> dict[str, str]:
        return {"status": "ok", "version": tracking3d.__version__}

    @app.post("/track")
    async def track(
        request: Request,
        box: Annotated[str, Query(max_length=80, description="x,y,width,height in the first frame, pixels")],
        fov: Annotated[float | None, Query(gt=1, lt=170, description="vertical, degrees")] = None,
    ) -> dict[str, Any]:
        """Send the video as the body; its poses come back when all of it has been tracked."""
        with tempfile.TemporaryDirectory(prefix="tracking3d-") as folder:
            video = Path(folder) / "video"
            with place_in(uploads, "Other videos are being sent; try again."):
                await receive(request, video, limits)
            with place_in(one_at_a_time, "Another video is being tracked; try again."):
                return await run_in_threadpool(answer, video, box, fov, limits)

    return app


@contextmanager
def place_in(places: threading.Semaphore, taken: str) -> Iterator[None]:
    """Take one of the places, at once or not at all."""
    if not places.acquire(blocking=False):
        raise HTTPException(503, taken, {"Retry-After": "30"})
    try:
        yield
    finally:
        places.release()


async def receive(request: Request, video: Path, limits: Limits) -> None:
    """Write the body of a request to a file, as far as it may go, and as long as it may take."""
    count, most = 0, limits.video_bytes
    try:
        with video.open("wb") as file, anyio.fail_after(limits.upload_seconds):
            async for chunk in request.stream():
                count += len(chunk)
                if count > most:
                    raise HTTPException(413, f"The video has more than {most} bytes; send a shorter one.")
                file.write(chunk)
    except TimeoutError as error:
        raise HTTPException(408, f"The video did not come within {limits.upload_seconds:g} s.") from error
    with video.open("rb") as file:
        head = file.read(16)
    if not any(head[start : start + len(mark)] == mark for mark, start in CONTAINERS.items()):
        raise HTTPException(415, "The body is no video that is taken here; send MP4, MOV, MKV, WebM or AVI.")


def answer(video: Path, box: str, fov: float | None, limits: Limits) -> dict[str, Any]:
    """Track through a video; what the sender can mend is told with status 422."""
    try:
        source = open_source(video, frames=f":{limits.frames}")
        config = tracking3d.load_config(camera={} if fov is None else {"fov": fov})
        with closing(iter(source)) as frames:
            return tracked(frames, parse_box(box), config, limits)
    except Tracking3dError as error:
        raise HTTPException(422, str(error).replace(str(video), "The video")) from error


def tracked(frames: Iterable[Any], box: Any, config: Any, limits: Limits) -> dict[str, Any]:
    """The answer for each frame, better ones in place of earlier ones, until the time is up."""
    answers: dict[int, FrameEstimate] = {}
    end, complete = time.monotonic() + limits.seconds, True
    for estimate in tracking3d.track(checked(frames, limits.pixels), box=box, config=config):
        answers |= {one.index: one for one in (*estimate.revised, estimate)}
        if time.monotonic() > end:
            complete = False
            break
    return {
        "conventions": "T_cam_obj: x_cam = R x_obj + t; OpenCV camera axes; the unit of length is arbitrary",
        "complete": complete,
        "frames": [
            {
                "index": index,
                "status": str(one.status),
                "confidence": round(one.confidence, 3),
                "T_cam_obj": one.T_cam_obj.round(6).tolist(),
            }
            for index, one in sorted(answers.items())
        ],
    }


def checked(frames: Iterable[Any], most: int) -> Iterable[Any]:
    """The frames, whose pictures are not too large."""
    for frame in frames:
        size = getattr(frame, "size", (0, 0))
        if size[0] * size[1] > most:
            raise HTTPException(413, f"Its pictures have more than {most} pixels; send a smaller one.")
        yield frame


app = service()
