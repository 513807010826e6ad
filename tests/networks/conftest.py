"""A cache of one's own, and a web server on this machine that gives what a test tells it to."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from known_bytes import BYTES

from tracking3d.networks.catalogue import KnownNetwork


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, which is not there yet."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("TRACKING3D_CACHE", str(folder))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
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


@pytest.fixture
def serve() -> Iterator[Callable[..., str]]:
    """Start a server that gives some bytes; returns their address."""
    servers = []

    def serve(body: bytes = BYTES, status: int = 200, claimed: int | None = None) -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(status)
                self.send_header("Content-Length", str(len(body) if claimed is None else claimed))
                self.end_headers()
                with suppress(ConnectionError):  # who has enough hangs up
                    self.wfile.write(body)

            def log_message(self, *given: Any) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        servers.append((server, thread))
        return f"http://127.0.0.1:{server.server_address[1]}/tiny-net.onnx"

    yield serve
    for server, thread in servers:
        server.shutdown()
        thread.join()
        server.server_close()
