"""A video goes in, poses come out; what strangers send is bounded, and leaves nothing behind."""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra `service` is not installed")
pytest.importorskip("httpx", reason="the extra `service` is not installed")

import anyio
import httpx
from example_modules import example
from fastapi import HTTPException

from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.video import VideoWriter

service = example("service/app")
URL = "/track?box=20,15,30,25"


@pytest.fixture(scope="module")
def clip():
    return synthesize(SyntheticSpec(frames=4, size=(80, 60)))


@pytest.fixture(scope="module")
def video(clip, tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("videos") / "clip.mp4"
    with VideoWriter(path, 10, clip.images.shape[1:3]) as writer:
        for image in clip.images:
            writer.write(image)
    return path.read_bytes()


@pytest.fixture(autouse=True)
def nothing_is_left(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    yield
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def at_once(monkeypatch) -> None:
    """An answer to each frame without looking at it, the first one bettered by the third."""

    def answered(index: int, z: float, **more) -> FrameEstimate:
        T = np.eye(4)
        T[2, 3] = z
        mask = np.zeros((60, 80), bool)
        return FrameEstimate(index, None, T, mask, mask, Status.TRACKED, "", 0.75, **more)

    def track(frames, box, config):
        assert box == (20, 15, 30, 25)
        for n, _ in enumerate(frames):
            yield answered(n, 3.0 + n, revised=(answered(0, 9.0),) if n == 2 else ())

    monkeypatch.setattr(service.tracking3d, "track", track)


class Client:
    """Asks an application in this process, as a browser would."""

    def __init__(self, app: Any) -> None:
        self._app = app

    def get(self, url: str) -> httpx.Response:
        return anyio.run(self.ask, "GET", url, None)

    def post(self, url: str, content: Any) -> httpx.Response:
        return anyio.run(self.ask, "POST", url, content)

    async def ask(self, method: str, url: str, content: Any) -> httpx.Response:
        transport = httpx.ASGITransport(app=self._app)
        async with httpx.AsyncClient(transport=transport, base_url="http://service") as client:
            return await client.request(method, url, content=content)


def client(**limits: Any) -> Client:
    return Client(service.service(service.Limits(**limits)))


def test_every_frame_has_a_pose_and_the_better_answer(video, at_once):
    answer = client().post(URL, content=video)
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert told["complete"]
    assert [frame["index"] for frame in told["frames"]] == [0, 1, 2, 3]
    assert [frame["T_cam_obj"][2][3] for frame in told["frames"]] == [9, 4, 5, 6]
    assert told["frames"][1] | {"T_cam_obj": 0} == {
        "index": 1,
        "status": "tracked",
        "confidence": 0.75,
        "T_cam_obj": 0,
    }


def test_only_so_many_frames_and_seconds(video, at_once):
    assert len(client(frames=2).post(URL, content=video).json()["frames"]) == 2
    told = client(seconds=-1).post(URL, content=video).json()
    assert (len(told["frames"]), told["complete"]) == (1, False)


def test_what_is_too_large_is_refused(video, at_once):
    assert client(video_bytes=len(video) - 1).post(URL, content=video).status_code == 413
    answer = client(pixels=80 * 60 - 1).post(URL, content=video)
    assert (answer.status_code, "pixels" in answer.json()["detail"]) == (413, True)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"no video",
        b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n",
        b"ffconcat version 1.0\nfile '/etc/passwd'\n",
    ],
    ids=["empty", "text", "play list", "concatenation"],
)
def test_what_is_no_video_is_refused(body):
    assert client().post(URL, content=body).status_code == 415


def test_a_container_with_nothing_in_it_is_told_without_our_paths(video):
    answer = client().post(URL, content=video[:200])
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith("The video")
    assert "tracking3d-" not in answer.json()["detail"]


@pytest.mark.parametrize("query", ["", "?box=1,2,3", "?box=a", "?box=0,0,-1,5", "?box=1,1,5,5&fov=400"])
def test_a_box_or_lens_that_is_none_is_told(video, query):
    answer = client().post(f"/track{query}", content=video)
    assert (answer.status_code, bool(answer.json()["detail"])) == (422, True)


def test_an_upload_that_drips_is_ended_and_takes_no_place_meanwhile(video, at_once):
    one, seen = client(upload_seconds=1.0), []

    async def drops():
        yield video[:16]
        seen.append((await one.ask("POST", URL, content=video)).status_code)
        while True:
            await anyio.sleep(0.1)
            yield b"x"

    dripping = one.post(URL, content=drops())
    assert (dripping.status_code, seen) == (408, [200])
    assert one.post(URL, content=video).status_code == 200


def test_one_at_a_time(video, at_once, monkeypatch):
    one = client()
    seen = []

    def answer_while_another_asks(*arguments):
        seen.append(one.post(URL, content=video).status_code)
        raise HTTPException(418)

    monkeypatch.setattr(service, "answer", answer_while_another_asks)
    assert one.post(URL, content=video).status_code == 418
    assert seen == [503]
    monkeypatch.undo()
    assert one.get("/health").json()["status"] == "ok"


@pytest.mark.slow
def test_a_real_video_is_tracked(video, clip):
    box = ",".join(f"{side:g}" for side in clip.box)
    told = client().post(f"/track?box={box}", content=video).json()
    assert [frame["index"] for frame in told["frames"]] == [0, 1, 2, 3]
    assert {frame["status"] for frame in told["frames"]} <= {"tracked", "uncertain", "lost"}
