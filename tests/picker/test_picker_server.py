"""The picker's server: what it gives its own page, and what it does with everything else."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import time

import pytest
from raw_requests import raw_request, request, status

from tracking3d.ui.picker import server as server_module
from tracking3d.ui.picker.server import LARGEST_BODY, MOST_CONNECTIONS, Picker
from tracking3d.ui.web.access import Access

BOX = {"name": "cup", "colour": "#00a5e0", "frame": 0, "box": [30, 20, 36, 24]}
POINTS = {**BOX, "box": None, "points": [{"x": 48, "y": 32, "on": True}]}


def post(picker: Picker, path: str, told, **headers) -> bytes:
    return whole(picker, request("POST", path, json.dumps(told).encode(), **headers))


def whole(picker: Picker, text: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", picker.port), timeout=20) as connection:
        connection.sendall(text)
        return b"".join(iter(lambda: connection.recv(65536), b""))


def body(answer: bytes):
    return json.loads(answer.partition(b"\r\n\r\n")[2])


@pytest.mark.parametrize(
    "path", ["/", "/picker.js", "/picker.css", "/session.json", "/frame/0.jpg", "/frame/5.jpg"]
)
def test_the_page_and_its_parts_are_served(picker, path):
    answer = whole(picker, request("GET", path))
    assert status(answer) == 200 and b"default-src 'self'" in answer and b"no-store" in answer


@pytest.mark.parametrize(
    "path",
    [
        "/frame/6.jpg",
        "/frame/-1.jpg",
        "/frame/999999999.jpg",
        "/frame/0.jpg/",
        "/etc/passwd",
        "/../server.py",
        "/%2e%2e/server.py",
        "/page/picker.js",
        "/picker.js%00",
        "/picker.py",
    ],
)
def test_nothing_else_is(picker, path):
    assert status(whole(picker, request("GET", path))) == 404


def test_the_mask_of_what_is_drawn_is_shown(picker):
    for drawn in (BOX, POINTS):
        told = body(post(picker, "/mask", drawn))
        assert told["veil"].startswith("data:image/png;base64,") and 600 < told["area"] < 1100


@pytest.mark.parametrize(
    ("path", "told"),
    [
        ("/mask", {**BOX, "box": None}),
        ("/mask", {**BOX, "frame": 77}),
        ("/mask", {**BOX, "box": [900, 900, 5, 5]}),
        ("/start", {"objects": []}),
        ("/start", {"objects": [BOX, {**BOX, "frame": 2}]}),
        ("/save", {"objects": [BOX], "folder": "/tmp"}),
    ],
)
def test_what_cannot_be_used_is_told_in_a_sentence(picker, path, told):
    answer = post(picker, path, told)
    assert status(answer) == 422 and answer.rstrip().endswith(b".")
    assert picker.picked is None


def test_saving_writes_the_files_and_starting_hands_over_what_was_picked(picker, tmp_path):
    told = body(post(picker, "/save", {"objects": [BOX]}))
    assert "--box 30,20,36,24" in told["command"] and "tracker:" in told["settings"] and picker.picked is None
    told = body(post(picker, "/start", {"objects": [{**BOX, "frame": 3}, {**POINTS, "frame": 3}]}))
    picked = picker.wait()
    assert (picked.frame, len(picked.masks), picked.boxes) == (3, 2, [])
    assert (tmp_path / "out" / "picked" / "object_1.png").is_file() and "--start-frame 3" in told["command"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": None},
        {"Origin": "http://127.0.0.1:1"},
    ],
)
def test_forged_requests_are_refused_and_do_nothing(picker, tmp_path, headers):
    for path in ("/mask", "/save", "/start"):
        assert status(post(picker, path, {"objects": [BOX]}, **headers)) == 403
    assert picker.picked is None and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", "", None]
)
def test_a_form_of_another_page_cannot_be_sent(picker, kind):
    assert status(post(picker, "/start", {"objects": [BOX]}, Content_Type=kind)) == 415


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "HEAD", "TRACE", "BREW"])
def test_other_methods_are_not_known(picker, method):
    assert status(whole(picker, request(method, "/start"))) == 501


def test_elsewhere_a_token_is_needed(session):
    picker = Picker(session, lambda picked: ("", ""), Access("127.0.0.1", "secret"), 0)
    try:
        assert status(whole(picker, request("GET", "/"))) == 401
        assert status(post(picker, "/start", {"objects": [BOX]})) == 401
        assert status(post(picker, "/start?token=wrong", {"objects": [BOX]})) == 401
        answer = whole(picker, request("GET", "/?token=secret"))
        cookie = answer.partition(b"Set-Cookie: ")[2].partition(b";")[0].decode()
        assert status(answer) == 303
        assert status(whole(picker, request("GET", "/session.json", Cookie=cookie))) == 200
        assert status(post(picker, "/mask", BOX, Cookie=cookie)) == 200
    finally:
        picker.close()


@pytest.mark.parametrize("length", [LARGEST_BODY + 1, 100_000_000, 10**12 - 1])
def test_a_large_body_is_refused_before_it_is_read(picker, length):
    text = request("POST", "/mask", Content_Length=str(length)) + b"x" * 1000
    assert status(raw_request(picker.port, text)) == 413


@pytest.mark.parametrize("length", ["-1", "1e9", "", "0x10", "9" * 13, None])
def test_a_length_that_is_none_is_refused(picker, length):
    assert status(raw_request(picker.port, request("POST", "/mask", b"{}", Content_Length=length))) == 411


@pytest.mark.slow
def test_a_hundred_megabytes_are_not_taken(picker):
    with socket.create_connection(("127.0.0.1", picker.port), timeout=20) as connection:
        connection.sendall(request("POST", "/mask", Content_Length="100000000"))
        sent = 0
        try:
            while sent < 100_000_000:
                sent += connection.send(b"x" * 2**20)
        except OSError:
            pass
    assert sent < 50_000_000
    assert status(whole(picker, request("GET", "/session.json"))) == 200


def test_a_browser_that_goes_away_in_the_middle_is_forgotten(picker, monkeypatch):
    for text in (b"", b"GET / HT", request("POST", "/mask", Content_Length="5000") + b"{"):
        connection = socket.create_connection(("127.0.0.1", picker.port), timeout=10)
        connection.sendall(text)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()
    assert status(whole(picker, request("GET", "/"))) == 200


def test_who_says_nothing_is_not_waited_for(session, monkeypatch):
    monkeypatch.setattr(server_module._Handler, "timeout", 0.2)
    picker = Picker(session, lambda picked: ("", ""), Access(), 0)
    try:
        with socket.create_connection(("127.0.0.1", picker.port), timeout=20) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
            assert connection.recv(100) == b""
    finally:
        picker.close()


@pytest.mark.parametrize(
    "beginning", [b"", b"GET / HTTP/1.1\r\nX-A: ", request("POST", "/mask", Content_Length="5000")]
)
def test_a_request_that_trickles_in_is_ended_however_often_something_comes(session, monkeypatch, beginning):
    monkeypatch.setattr(server_module._Handler, "timeout", 0.3)
    picker = Picker(session, lambda picked: ("", ""), Access(), 0)
    until, ended = time.monotonic() + 10, False
    try:
        with socket.create_connection(("127.0.0.1", picker.port), timeout=0.05) as connection:
            connection.sendall(beginning)
            while not ended and time.monotonic() < until:
                try:
                    connection.sendall(b"x")
                    ended = connection.recv(100) == b""
                except TimeoutError:
                    continue
                except ConnectionError:
                    ended = True
    finally:
        picker.close()
    assert ended


SLOW = {
    "silent": b"",
    "without an end of the header": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ",
    "without an end of the body": request("POST", "/mask", Content_Length="5000") + b"{",
    "with a wrong token": request("POST", "/mask?token=wrong", Content_Length="5000") + b"{",
}


@pytest.mark.parametrize("token", ["", "secret"])
@pytest.mark.parametrize("kind", SLOW)
def test_slow_connections_shut_nobody_out(session, monkeypatch, kind, token):
    monkeypatch.setattr(server_module._Handler, "timeout", 300.0)
    picker = Picker(session, lambda picked: ("", ""), Access("127.0.0.1", token), 0)
    slow = []
    try:
        for _ in range(MOST_CONNECTIONS + 8):
            slow.append(socket.create_connection(("127.0.0.1", picker.port), timeout=20))
            with contextlib.suppress(ConnectionError):
                slow[-1].sendall(SLOW[kind])
        for _ in range(3):
            assert status(whole(picker, request("GET", f"/?token={token}"))) == (303 if token else 200)
            cookie = f"tracking3d_{picker.port}={token}"
            assert status(post(picker, "/mask", BOX, Cookie=cookie)) == 200
    finally:
        for one in slow:
            one.close()
        picker.close()


def test_who_knows_the_token_gives_way_to_nobody_who_does_not(session):
    picker = Picker(session, lambda picked: ("", ""), Access("127.0.0.1", "secret"), 0)
    content = json.dumps(BOX).encode()
    text = request("POST", "/mask", content, Cookie=f"tracking3d_{picker.port}=secret")
    waiting = []
    try:
        with socket.create_connection(("127.0.0.1", picker.port), timeout=20) as connection:
            connection.sendall(text[: -len(content)] + content[:1])
            until = time.monotonic() + 20
            while not picker._server.connections._settled and time.monotonic() < until:
                time.sleep(0.01)
            for _ in range(2 * MOST_CONNECTIONS):
                waiting.append(socket.create_connection(("127.0.0.1", picker.port), timeout=20))
            for one in waiting[:MOST_CONNECTIONS]:  # the rest of them are waited for still
                with contextlib.suppress(ConnectionError):
                    assert one.recv(1) == b""
            connection.sendall(content[1:])
            assert status(connection.recv(65536)) == 200
    finally:
        for one in waiting:
            one.close()
        picker.close()


@pytest.mark.parametrize("count", [2 * MOST_CONNECTIONS, pytest.param(1000, marks=pytest.mark.slow)])
def test_of_a_crowd_the_earliest_are_turned_away_and_the_page_is_served(picker, count):
    waiting = []
    for _ in range(count):
        waiting.append(socket.create_connection(("127.0.0.1", picker.port), timeout=20))
    for one in waiting[:-MOST_CONNECTIONS]:
        with contextlib.suppress(ConnectionError):
            assert one.recv(1) == b""
    assert status(whole(picker, request("GET", "/"))) == 200
    for one in waiting:
        one.close()
    assert status(whole(picker, request("GET", "/"))) == 200


def test_where_all_are_worked_on_a_newcomer_is_turned_away(picker):
    ends = [socket.socketpair() for _ in range(MOST_CONNECTIONS)]
    connections = picker._server.connections
    for ours, _ in ends:
        assert connections.add(ours) and connections.settle(ours)
    assert raw_request(picker.port, request("GET", "/")) == b""
    for ours, theirs in ends:
        connections.remove(ours)
        ours.close(), theirs.close()
    assert status(whole(picker, request("GET", "/"))) == 200
