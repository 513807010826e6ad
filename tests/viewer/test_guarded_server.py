"""Viser answers nobody but its own page."""

from __future__ import annotations

import logging
import socket
import struct
import time
from contextlib import closing

import pytest
from raw_requests import raw_request, request, status

pytest.importorskip("viser", reason="viser is absent: pip install 'tracking3d[view]'")

import viser
import websockets.exceptions
from websockets.sync.client import connect

from tracking3d.errors import PluginError
from tracking3d.ui.viewer import guarded_server
from tracking3d.ui.viewer.guarded_server import LARGEST_MESSAGE, MOST_CONNECTIONS, start_server
from tracking3d.ui.web.access import Access

OURS = [f"viser-v{viser.__version__}"]


@pytest.fixture
def server():
    server = start_server(Access(), 0)
    yield server
    server.stop()


def socket_of(port: int, origin: str | None, **more):
    return connect(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=OURS, max_size=None, **more)


def our_socket(port: int):
    return socket_of(port, f"http://127.0.0.1:{port}")


def answers(port: int) -> bool:
    """Whether the page, and what it connects to, are still served."""
    with our_socket(port) as connection:
        connection.recv(timeout=10)
    return status(raw_request(port, request("GET", "/"))) == 200


def test_the_page_is_served_and_its_socket_opens(server):
    assert answers(server.get_port())
    estimate = raw_request(server.get_port(), request("GET", "/"))
    assert b"frame-ancestors 'none'" in estimate and b"no-referrer" in estimate


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
    ],
)
def test_forged_requests_are_refused(server, headers):
    assert status(raw_request(server.get_port(), request("GET", "/", **headers))) == 403


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null", "http://127.0.0.1:1"])
def test_a_socket_of_another_page_is_refused(server, origin):
    with pytest.raises(websockets.exceptions.InvalidStatus) as refused, socket_of(server.get_port(), origin):
        pass
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("upgrade", ["websocket", "WebSocket", "h2c"])
def test_an_upgrade_in_any_spelling_passes_the_check(server, upgrade):
    headers = {"Connection": "Upgrade", "Upgrade": upgrade, "Origin": "http://evil.example"}
    estimate = raw_request(server.get_port(), request("GET", "/", Sec_WebSocket_Version="13", **headers))
    assert status(estimate) == 403


@pytest.mark.parametrize(
    "path", ["/../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/..%5c..%5cetc", "//etc/passwd"]
)
def test_no_path_leads_out_of_the_page(server, path):
    assert status(raw_request(server.get_port(), request("GET", path))) in (400, 404)


@pytest.mark.parametrize(
    "text",
    [
        b"\x00" * 100 + b"\r\n",
        b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 500 + b"\r\n",
        b"GET /" + b"a" * 99_999 + b"\r\n",
    ],
    ids=["nulls", "many headers", "a long path"],
)
def test_nonsense_ends_its_own_connection_only(server, text):
    raw_request(server.get_port(), text)
    assert answers(server.get_port())


def test_elsewhere_the_token_opens_the_page_and_its_cookie_the_socket():
    server = start_server(Access("127.0.0.1", "secret"), 0)
    try:
        port = server.get_port()
        assert status(raw_request(port, request("GET", "/"))) == 401
        assert status(raw_request(port, request("GET", "/?token=wrong"))) == 401
        estimate = raw_request(port, request("GET", "/?token=secret"))
        assert status(estimate) == 303 and b"\r\nLocation: /\r\n" in estimate
        cookie = estimate.partition(b"Set-Cookie: ")[2].partition(b";")[0].decode()
        assert status(raw_request(port, request("GET", "/", Cookie=cookie))) == 200
        with pytest.raises(websockets.exceptions.InvalidStatus):
            our_socket(port)
        with socket_of(port, f"http://127.0.0.1:{port}", additional_headers={"Cookie": cookie}) as connection:
            connection.recv(timeout=10)
    finally:
        server.stop()


@pytest.mark.parametrize("size", [LARGEST_MESSAGE + 1, 100_000_000])
def test_a_large_message_ends_its_connection_before_it_is_read(server, size):
    port = server.get_port()
    with closing(our_socket(port)) as connection:
        head = b"\x82\xff" + struct.pack(">Q", size) + b"\x00\x00\x00\x00"
        connection.socket.sendall(head + b"x" * 1000)
        with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
            while True:
                connection.recv(timeout=10)
        assert closed.value.rcvd.code == 1009
    assert answers(port)


@pytest.mark.parametrize(
    "message",
    ["text", b"", b"\xc1", b"\x80", b"\x81\xa4type\xa4Evil", b"\x81\xa4type\xbaFileTransferStartUpload"],
)
def test_what_the_page_never_sends_ends_its_connection_only(server, message):
    port = server.get_port()
    with closing(our_socket(port)) as connection, pytest.raises(websockets.exceptions.ConnectionClosed):
        connection.send(message)
        while True:
            connection.recv(timeout=10)
    assert answers(port)


def test_a_browser_that_goes_away_in_the_middle_is_forgotten(server):
    port = server.get_port()
    for _ in range(5):
        connection = our_socket(port)
        connection.recv(timeout=10)
        linger = struct.pack("ii", 1, 0)
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        connection.socket.close()  # a reset, not an end
    assert answers(port)


def crowd(port: int, count: int) -> list[socket.socket]:
    return [socket.create_connection(("127.0.0.1", port), timeout=10) for _ in range(count)]


@pytest.mark.parametrize("count", [2 * MOST_CONNECTIONS, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_crowd_is_turned_away_and_when_it_has_gone_the_page_is_served(server, count):
    port = server.get_port()
    waiting = crowd(port, count)
    hung_up = 0
    for one in waiting[MOST_CONNECTIONS:]:
        try:
            hung_up += one.recv(1) == b""
        except ConnectionError:
            hung_up += 1
    assert hung_up == count - MOST_CONNECTIONS
    for one in waiting:
        one.close()
    until = time.monotonic() + 20
    while time.monotonic() < until and status(raw_request(port, request("GET", "/"))) != 200:
        time.sleep(0.1)
    assert answers(port)


def test_a_viser_that_cannot_be_guarded_is_not_used(monkeypatch):
    original = websockets.asyncio.server.serve
    monkeypatch.setattr(guarded_server._Guard, "serve", property(lambda self: original), raising=False)
    with pytest.raises(PluginError, match="cannot be protected from other web pages"):
        start_server(Access(), 0)
    assert websockets.asyncio.server.serve is original


def test_nothing_is_printed_not_even_of_what_goes_wrong(server, capfd, caplog):
    with closing(our_socket(server.get_port())) as connection:
        connection.send(b"\xc1")
    time.sleep(0.2)
    assert capfd.readouterr() == ("", "")
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []
