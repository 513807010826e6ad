"""A cache of one's own, and a web server on this machine that gives what a test tells it to."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from known_bytes import BYTES

from tracking3d.features.networks.catalogue import KnownNetwork


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, which is not there yet."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("TRACKING3D_CACHE", str(folder))
    for name in ("http_proxy", "HTTP_PROXY", "https_proxy", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return folder


@pytest.fixture
def network() -> Callable[..., KnownNetwork]:
    """An entry of a catalogue whose bytes are `BYTES`."""

    def network(**changes: Any) -> KnownNetwork:
        entry = {
            "name": "tiny-net",
            "purpose": "tests",
            "licence": "Apache-2.0",
            "authors": "https://example.org/tiny",
            "address": "http://127.0.0.1:9/tiny-net.onnx",
            "size": len(BYTES),
            "sha256": hashlib.sha256(BYTES).hexdigest(),
        }
        return KnownNetwork.model_validate(entry | changes)

    return network


@dataclass
class Served:
    """What a server on this machine gives, and what it was asked.

    Attributes:
        body: The whole file.
        status: Answered where no range is; 206 needs ``ranges``.
        claimed: The length that is announced; the body's if None.
        ranges: Whether the server knows them.
        breaks: How many bytes each answer brings before the connection breaks off, None for all; the last one stays.
        asked: What was asked for: the path, and the header ``Range``.
    """

    body: bytes = BYTES
    status: int = 200
    claimed: int | None = None
    ranges: bool = False
    breaks: Sequence[int | None] = (None,)
    asked: list[tuple[str, str]] = field(default_factory=list)
    address: str = ""


@pytest.fixture
def serve_and_note() -> Iterator[Callable[..., Served]]:
    """Start a server as `Served` says; returns that, with its address."""
    servers = []

    def serve(**given: Any) -> Served:
        served = Served(**given)

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                wanted = self.headers.get("Range", "")
                most = served.breaks[min(len(served.asked), len(served.breaks) - 1)]
                served.asked.append((self.path, wanted))
                start = int(wanted[6:-1]) if wanted and served.ranges else 0
                body = served.body[start:]
                if start >= len(served.body):
                    self.send_response(416)
                    self.end_headers()
                    return
                self.send_response(206 if start else served.status)
                if start:
                    last = len(served.body) - 1
                    self.send_header("Content-Range", f"bytes {start}-{last}/{len(served.body)}")
                self.send_header(
                    "Content-Length", str(len(body) if served.claimed is None else served.claimed)
                )
                self.end_headers()
                with suppress(ConnectionError):  # who has enough hangs up
                    self.wfile.write(body[:most])

            def do_CONNECT(self) -> None:
                served.asked.append((self.path, "CONNECT"))
                self.send_error(403)

            def log_message(self, *given: Any) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        servers.append((server, thread))
        served.address = f"http://127.0.0.1:{server.server_address[1]}/tiny-net.onnx"
        return served

    yield serve
    for server, thread in servers:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def serve(serve_and_note: Callable[..., Served]) -> Callable[..., str]:
    """Start a server that gives some bytes; returns their address."""

    def serve(body: bytes = BYTES, status: int = 200, claimed: int | None = None) -> str:
        return serve_and_note(body=body, status=status, claimed=claimed).address

    return serve
