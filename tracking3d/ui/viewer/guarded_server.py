"""A viser server that serves only its own page.

Viser has no check of its own: it lets pages of any origin connect, takes messages of 50 MB and as many connections
as there are. All of that is decided where it calls `websockets.asyncio.server.serve`, so that call is the one thing
that is replaced here, while the server starts; if a version of viser no longer calls it, nothing is served.
"""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from tracking3d.errors import PluginError
from tracking3d.ui.web.access import SAFE_HEADERS, Access, Refusal

LARGEST_MESSAGE = 64 * 1024
"""Bytes of a message from a browser; what it has to say is a camera, a value or a click."""
MOST_CONNECTIONS = 64
"""Connections at a time, whatever they are; a browser needs one, and a few for a moment while it opens."""

_UPLOAD = b"FileTransferStartUpload"
_log = logging.getLogger("tracking3d.ui.viewer.connections")
_log.setLevel(logging.CRITICAL)  # a browser that goes away, or a stranger that talks nonsense, is no news
_serve = websockets.asyncio.server.serve
_Http = Callable[[ServerConnection, Request], Response | None]
_starting = threading.Lock()


def start_server(access: Access, port: int) -> viser.ViserServer:
    """Start a viser server behind the check of ``access``.

    Args:
        access: Where it listens, and whom it serves.
        port: The port; if it is taken, the next one that is free. 0 for any.

    Raises:
        PluginError: If this version of viser cannot be guarded.
    """
    guard = _Guard(access)
    with _starting:
        websockets.asyncio.server.serve = guard.serve
        try:
            with redirect_stdout(io.StringIO()):  # it prints an address, which lacks the token
                server = viser.ViserServer(host=access.host, port=port, verbose=False)
        finally:
            websockets.asyncio.server.serve = _serve
    if not guard.in_place:
        server.stop()
        raise PluginError(
            f"viser {viser.__version__} cannot be protected from other web pages; install the version "
            "required by tracking3d[view]."
        )
    guard.port = server.get_port()
    return server


class _Guard:
    """What stands between the network and viser.

    Args:
        access: Whom to serve.
    """

    def __init__(self, access: Access) -> None:
        self.access = access
        self.in_place = False
        self.port = 0
        self.connections = 0

    def serve(self, handler: Any, host: str, port: int, **options: Any) -> Any:
        """Stands in for `websockets.asyncio.server.serve`."""
        usual: _Http = options.pop("process_request")
        options.update(max_size=LARGEST_MESSAGE, max_queue=16, logger=_log)
        self.in_place = True
        return _serve(
            handler,
            host,
            port,
            process_request=lambda connection, request: self._answer(usual, connection, request),
            create_connection=self._connection(),
            **options,
        )

    def _connection(self) -> type[ServerConnection]:
        guard = self

        class CountedConnection(ServerConnection):
            """Closes the connection if there are too many, or if the client uploads: the viewer accepts no files."""

            def connection_made(self, transport: Any) -> None:
                guard.connections += 1
                super().connection_made(transport)
                if guard.connections > MOST_CONNECTIONS:
                    transport.abort()

            def connection_lost(self, exc: Exception | None) -> None:
                guard.connections -= 1
                super().connection_lost(exc)

            async def recv(self, decode: bool | None = None) -> Any:
                message = await super().recv(decode)
                if not isinstance(message, bytes) or _UPLOAD in message:
                    await self.close(1008, "not requested")
                    message = await super().recv(decode)  # raises that it is closed
                return message

        return CountedConnection

    def _answer(self, usual: _Http, connection: ServerConnection, request: Request) -> Response | None:
        socket = request.headers.get("Upgrade", "").lower() == "websocket"
        refusal = self.access.refusal(
            request.path,
            _one(request, "Host"),
            _one(request, "Origin"),
            _one(request, "Cookie"),
            self.port,
            from_page=socket,
        )
        if refusal is not None:
            return _refuse(connection, refusal)
        if self.access.gives_token(request.path) and not socket:
            estimate = connection.respond(303, "")
            estimate.headers["Location"] = urlsplit(request.path).path or "/"
            estimate.headers["Set-Cookie"] = self.access.cookie(self.port)
        elif (found := usual(connection, request)) is None:
            return None
        else:
            estimate = found
        return _with_safe_headers(estimate)


def _one(request: Request, name: str) -> str | None:
    """The header if it occurs once; a repeated header is ignored."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else ("" if values else None)


def _refuse(connection: ServerConnection, refusal: Refusal) -> Response:
    return _with_safe_headers(connection.respond(refusal.status, refusal.reason + "\n"))


def _with_safe_headers(response: Response) -> Response:
    headers: Headers = response.headers
    for name, value in SAFE_HEADERS.items():
        headers[name] = value
    return response
