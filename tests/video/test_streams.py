"""Videos by their address: a web server's files, streams that go on and break off, and addresses that are refused."""

from __future__ import annotations

import functools
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from sample_videos import encode_video, moving_picture, shown_numbers

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video import open_source, opening
from tracking3d.video.addresses import SCHEMES


class Silent:
    def log_message(self, *_: object) -> None:
        """Say nothing."""


class Files(Silent, SimpleHTTPRequestHandler):
    """The files of a folder."""


@pytest.fixture(autouse=True)
def hurried(monkeypatch) -> None:
    monkeypatch.setattr(opening, "PAUSE", 0.01)


@pytest.fixture
def serve() -> Iterator[Callable[..., str]]:
    servers = []

    def start(handler) -> str:
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        servers.append(server)
        return f"127.0.0.1:{server.server_address[1]}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def of_transport_stream(path: Path) -> bytes:
    images = [moving_picture(index) for index in range(10)]
    return encode_video(path / "clip.ts", images, options={"bf": "0"}).read_bytes()


def test_a_file_on_a_server_is_read_like_one_on_disk(tmp_path, serve):
    file = encode_video(tmp_path / "clip.mkv", [moving_picture(index) for index in range(12)])
    host = serve(functools.partial(Files, directory=str(tmp_path)))
    source = open_source(f"http://user:secret@{host}/clip.mkv", "2:9:2")
    assert source.repeatable and source.name == f"http://{host}/clip.mkv"
    local = open_source(file, "2:9:2")
    for _ in range(2):  # again and again
        frames = list(source)
        assert [frame.index for frame in frames] == [2, 4, 6, 8]
        assert shown_numbers(frames) == shown_numbers(list(local))
        assert [frame.time for frame in frames] == [frame.time for frame in local]
    assert (source.count, source.fps) == (local.count, local.fps)


def test_a_file_that_breaks_off_is_taken_up_where_it_was(tmp_path, serve):
    path = encode_video(tmp_path / "clip.mkv", [moving_picture(index) for index in range(30)])
    whole, asked = path.read_bytes(), []

    class BreaksOff(Silent, BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            start = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").split("-")[0])
            asked.append(start)
            self.send_response(206)
            self.send_header("Content-Length", str(len(whole) - start))
            self.send_header("Content-Range", f"bytes {start}-{len(whole) - 1}/{len(whole)}")
            self.send_header("Accept-Ranges", "bytes")
            self.end_headers()
            self.wfile.write(whole[start : start + len(whole) // 2])
            self.close_connection = True

    host = serve(BreaksOff)
    source = open_source(f"http://{host}/clip.mkv")
    asked.clear()
    assert shown_numbers(list(source)) == list(range(30))
    assert len(asked) >= 2 and max(asked) > 0


class Live(Silent, BaseHTTPRequestHandler):
    """A stream without a length: the same few pictures for every connection, then nothing more."""

    data = b""
    connections = 0
    most = 3

    def do_GET(self) -> None:
        cls = type(self)
        cls.connections += 1
        if cls.connections > cls.most:
            self.send_error(503)
            return
        self.send_response(200)
        self.send_header("Content-Type", "video/mp2t")
        self.end_headers()
        self.wfile.write(self.data)


def test_a_stream_that_is_lost_is_asked_for_again_a_few_times(tmp_path, serve, caplog):
    handler = type("Handler", (Live,), {"data": of_transport_stream(tmp_path), "connections": 0})
    host = serve(handler)
    source = open_source(f"http://{host}/live")
    assert isinstance(source, opening.LiveStream) and not source.repeatable and source.count is None
    items = list(source)
    assert [item.index for item in items] == list(range(20))  # two connections, the first one was to look
    assert any(isinstance(item, Frame) for item in items)
    assert all(isinstance(item, Frame) or "dropped" in item.reason for item in items)
    assert "trying again in 0.01 s (1 of 3)" in caplog.text
    assert "could not be reconnected after 3 attempts" in caplog.text
    assert handler.connections == 3 + opening.TRIES


def test_a_stream_that_ends_again_and_again_has_ended(tmp_path, serve, caplog):
    handler = type("Handler", (Live,), {"data": of_transport_stream(tmp_path), "connections": 0, "most": 50})
    items = list(open_source(f"http://{serve(handler)}/live"))
    assert handler.connections == 2 + opening.TRIES  # the first one was to look
    assert [item.index for item in items] == list(range(10 * (1 + opening.TRIES)))
    assert "ended 4 times" in caplog.text


def test_a_stream_gives_no_more_than_was_selected(tmp_path, serve):
    host = serve(type("Handler", (Live,), {"data": of_transport_stream(tmp_path), "connections": 0}))
    items = list(open_source(f"http://{host}/live", ":4"))
    assert [item.index for item in items] == [0, 1, 2, 3]
    assert not any(isinstance(item, SkippedFrame) and "dropped" not in item.reason for item in items)


@pytest.mark.parametrize("scheme", ["http", "rtsp"])
def test_a_server_that_says_nothing_is_given_up(scheme, monkeypatch):
    monkeypatch.setattr(opening, "OPENING", 0.5)
    monkeypatch.setattr(opening, "READING", 0.5)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        with pytest.raises(InputError, match=r"cannot be opened .*responds within 0.5 seconds"):
            open_source(f"{scheme}://127.0.0.1:{silent.getsockname()[1]}/x")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_nobody_there_is_one_sentence_without_the_password(scheme):
    with socket.socket() as taken:  # bound, and not listening
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}/x"
        with pytest.raises(InputError, match="cannot be opened") as error:
            open_source(f"{scheme}://user:secret@{address}")
    assert "secret" not in str(error.value)


class Rtsp(threading.Thread):
    """A server of the real-time streaming protocol that refuses what is asked for."""

    def __init__(self, answer: bytes) -> None:
        super().__init__(daemon=True)
        self.socket, self.answer, self.asked = socket.create_server(("127.0.0.1", 0)), answer, b""

    def run(self) -> None:
        with suppress(OSError), self.socket, self.socket.accept()[0] as connection:
            while data := connection.recv(4096):
                self.asked += data
                connection.sendall(self.answer)


@pytest.mark.parametrize(
    "answer",
    [
        pytest.param(b"RTSP/1.0 404 Not Found\r\nCSeq: 1\r\n\r\n", id="404"),
        # OpenCV waits ten seconds for these
        pytest.param(b"HTTP/1.1 200 OK\r\n\r\n", id="HTTP", marks=pytest.mark.slow),
        pytest.param(b"\0" * 64, id="zeros", marks=pytest.mark.slow),
    ],
)
def test_an_rtsp_server_that_has_no_stream(answer):
    server = Rtsp(answer)
    server.start()
    with pytest.raises(InputError, match="cannot be opened"):
        open_source(f"rtsp://127.0.0.1:{server.socket.getsockname()[1]}/camera")
    assert server.asked.startswith(b"OPTIONS rtsp://127.0.0.1")


@pytest.mark.parametrize(
    "name",
    [
        "file:/etc/passwd",
        "concat:a.mp4|b.mp4",
        "data:text/plain,x",
        "subfile:,,start,0,end,9,,:x.mp4",
        "lavfi:testsrc",
        "FTP://host/x.mp4",
        "udp://127.0.0.1:5000",
        "crypto+file:x",
    ],
)
def test_other_protocols_are_refused(name):
    with pytest.raises(
        InputError, match="are not supported; give a path, or an address that begins with http"
    ):
        open_source(name)


@pytest.mark.parametrize("name", ["http:///x", "http://[", "rtsp://", "https:x"])
def test_an_address_without_a_server_is_refused(name):
    with pytest.raises(InputError, match="contains no server"):
        open_source(name)


def test_a_playlist_of_local_files_is_not_followed(tmp_path, serve):
    """What a server answers decides nothing about files on this machine."""
    clip = encode_video(tmp_path / "clip.ts", [moving_picture(0)] * 5)
    lists = {
        "list.m3u8": f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile://{clip}\n#EXT-X-ENDLIST\n",
        "list.ffconcat": f"ffconcat version 1.0\nfile {clip}\n",
    }
    for name, text in lists.items():
        (tmp_path / name).write_text(text)
        host = serve(functools.partial(Files, directory=str(tmp_path)))
        with pytest.raises(InputError):
            list(open_source(f"http://{host}/{name}"))


def test_a_file_of_that_name_wins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    encode_video(tmp_path / "plain.mp4", [moving_picture(3)]).rename(tmp_path / "data:x.mp4")
    assert shown_numbers(list(open_source("data:x.mp4"))) == [3]
