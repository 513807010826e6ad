"""The page's server: a handful of bounded responses, on the standard library."""

from __future__ import annotations

import _thread
import io
import json
import re
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, Tracking3dError
from tracking3d.results import layout
from tracking3d.results.files import read_mask
from tracking3d.ui.picker.drawing import Drawing, DrawnObject, parse
from tracking3d.ui.picker.session import (
    ChosenSettings,
    Picked,
    PickingSession,
    setting_choices,
    settings_in_words,
    tracker_lines,
)
from tracking3d.ui.web.access import SAFE_HEADERS, Access
from tracking3d.ui.web.connections import Connections, TimedReader

LARGEST_BODY = 2 * 2**20
"""Bytes that a request may bring: every stroke of every object."""
MOST_CONNECTIONS = 32
"""Requests that are worked on at a time; a browser needs a few."""
PATIENCE = 15.0
"""Seconds that a request may take to arrive, and its response to be taken."""
LEFT = 90.0
"""Seconds without a request after which the page is closed; a browser may wake one that is hidden once a minute."""
_POLL = 0.05  # seconds until it is seen that the server is to stop
_PORTS = 100  # that are tried, from the wanted one on
_FILE = re.compile(r"/run/(\d{1,2})/([a-z_]{1,20}\.[a-z0-9]{1,5})")
_FRAME = re.compile(r"/frame/(\d{1,9})\.jpg")
_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/picker.js": ("picker.js", "text/javascript; charset=utf-8"),
    "/picker.css": ("picker.css", "text/css; charset=utf-8"),
}
_POLICY = (
    "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True)
class PageProgress:
    """How far a run or a correction is."""

    running: bool = False  # whether it goes on
    sentence: str = ""  # how far, or how it ended; empty if there was none
    failed: bool = False  # whether it ended without a result
    share: float | None = None  # what is done of it, in [0, 1]; None if unknown
    frame: int | None = None  # index of the latest frame that was estimated; None if there is none


@dataclass(frozen=True)
class ShownRun:
    """The run that a page shows once it has started."""

    folders: Sequence[Path]  # the run folders of its objects
    progress: Callable[[], PageProgress]  # how far it is
    view: Callable[[], str] | None = None  # opens the viewer, and gives its address; None without it


class Picker:
    """Serves the page until it is closed: first to pick the object, then to look at the run.

    Args:
        session: What the page asks for.
        save: Writes what was picked to the run folder, and gives the command of the run and the settings as YAML.
        access: Where to listen, and whom to serve.
        port: The port, or the next one that is free; 0 for any.
        picked: What was picked before, if a run is continued.

    Raises:
        InputError: If it cannot listen there.
    """

    def __init__(
        self,
        session: PickingSession,
        save: Callable[[Picked], tuple[str, str]],
        access: Access,
        port: int,
        picked: Picked | None = None,
    ) -> None:
        self.session, self.save, self.access = session, save, access
        self.picked, self.run = picked, ShownRun((), lambda: PageProgress(True, "Starting …"))
        self.ends = ExitStack()  # of what is opened from the page
        self._over = threading.Event()
        self._asked = time.monotonic()
        self._server = _listening(self, access.host, port)
        self.port: int = self._server.server_address[1]
        self.address = access.address(self.port)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL,), name="picker", daemon=True
        )
        self._thread.start()

    def wait(self) -> Picked:
        """What the person picked, once the run is to start."""
        if self.picked is None:
            self._over.wait()
        assert self.picked is not None
        return self.picked

    def wait_until_left(self) -> None:
        """Wait until nobody has the page open any more, which asks for the progress while it is."""
        while time.monotonic() - self._asked < LEFT:
            time.sleep(_POLL)

    def told(self, path: str) -> Any | None:
        """The JSON response to a GET request of the page; None if there is none."""
        if path == "/session.json":
            return {**_describe(self.session), "started": self.picked is not None}
        if path != "/progress.json":
            return None
        self._asked, now = time.monotonic(), self.run.progress()
        reports = [n for n, one in enumerate(self.run.folders) if (one / layout.REPORT).is_file()]
        return {
            **asdict(now),
            "veils": [] if now.frame is None else self._veils(now.frame),
            "reports": [f"run/{number}/{layout.REPORT}" for number in reports if not now.running],
            "viewer": self.run.view is not None,
        }

    def file(self, number: int, name: str) -> Path | None:
        """A file of the run of an object, which its report links to; None if there is none."""
        names = {*chain(*layout.OUTPUTS.values()), layout.MTL, layout.TEXTURE} - {layout.MASKS}
        path = self.run.folders[number] / name if number < len(self.run.folders) and name in names else None
        return path if path is not None and path.is_file() else None

    def order(self, path: str, body: bytes) -> tuple[Any, Callable[[], None]] | None:
        """Do what the page orders.

        Args:
            path: What it asks for.
            body: What it brings.

        Returns:
            The JSON response, and what to do after it is sent; None if there is no such command.

        Raises:
            Tracking3dError: If it cannot be done.
        """
        if path == "/stop" and self.picked is not None:
            return {}, _interrupt
        if path == "/view" and self.run.view is not None:
            return {"address": self.run.view()}, _nothing
        if path == "/mask":
            drawn = parse(body, DrawnObject)
            return self.show(self.session.mask(drawn), drawn.colour)
        if path == "/settings":
            self.session.choose(parse(body, ChosenSettings, "settings", "they"))
            return {"tracker": self.session.config.tracker.name, **_describe_settings(self.session)}, _nothing
        if path not in ("/save", "/start"):
            return None
        picked = self.session.picked(parse(body, Drawing))
        command, settings = self.save(picked)
        then = partial(self.start, picked) if path == "/start" else _nothing
        return {"command": command, "settings": settings}, then

    def show(self, mask: NDArray[np.bool_], colour: str) -> tuple[Any, Callable[[], None]]:
        """The response that shows a mask ``(H, W)``; see `order`."""
        return {"veil": self.session.veil(mask, colour), "area": int(mask.sum())}, _nothing

    def _veils(self, frame: int) -> list[str]:
        """The masks of all objects in a frame, each in the colour that it was picked with."""
        objects = self.picked.objects if self.picked is not None else ()
        masks = [
            (one, read_mask(layout.mask_path(folder, frame)))
            for one, folder in zip(objects, self.run.folders, strict=False)
        ]
        return [self.session.veil(mask, one.colour) for one, mask in masks if mask is not None]

    def start(self, picked: Picked) -> None:
        """The run is to start with that."""
        self.picked = picked
        self._over.set()

    def close(self) -> None:
        """Stop serving."""
        self.ends.close()
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    request_queue_size = 128

    def __init__(self, address: tuple[str, int], picker: Picker) -> None:
        self.picker = picker
        self.connections = Connections(MOST_CONNECTIONS)
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a request in a thread, or close the connection if there are too many."""
        if not self.connections.add(request):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:
            self.connections.remove(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """What each thread does."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.connections.remove(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away is no news."""


class _Handler(BaseHTTPRequestHandler):
    timeout = PATIENCE
    server: _Server
    server_version, sys_version = "tracking3d", ""

    def setup(self) -> None:
        """Limit the time of the whole request."""
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(TimedReader(self.connection, self.timeout))

    def do_GET(self) -> None:
        if not self._may(from_page=False):
            return
        path = urlsplit(self.path).path
        picker = self.server.picker
        if picker.access.gives_token(self.path):
            self._send(HTTPStatus.SEE_OTHER, b"", Location="/", Set_Cookie=picker.access.cookie(picker.port))
        elif path in _PAGE:
            name, kind = _PAGE[path]
            self._send(HTTPStatus.OK, (files("tracking3d.ui.picker") / "page" / name).read_bytes(), kind)
        elif (told := picker.told(path)) is not None:
            self._send_json(told)
        elif (found := _FILE.fullmatch(path)) and (file := picker.file(int(found[1]), found[2])):
            kind = "text/html; charset=utf-8" if file.suffix == ".html" else "application/octet-stream"
            # The report has a policy of its own, and runs its own script only.
            self._send(HTTPStatus.OK, file.read_bytes(), kind, **SAFE_HEADERS)
        elif found := _FRAME.fullmatch(path):
            picture = picker.session.picture(int(found[1]))
            if picture is None:
                self._refuse(HTTPStatus.NOT_FOUND, "The frame does not exist or cannot be read.")
            else:
                self._send(HTTPStatus.OK, picture, "image/jpeg")
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "This page does not exist.")

    def do_POST(self) -> None:
        if not self._may(from_page=True) or (body := self._body()) is None:
            return
        try:
            done = self.server.picker.order(self.path, body)
        except Tracking3dError as error:
            return self._refuse(HTTPStatus.UNPROCESSABLE_ENTITY, error.at_the_command_line)
        if done is None:
            return self._refuse(HTTPStatus.NOT_FOUND, "This page does not exist.")
        told, then = done
        self._send_json(told)
        then()

    def _may(self, from_page: bool) -> bool:
        """Whether the request is allowed; if not, it is refused before anything else of it is read."""
        picker = self.server.picker
        refusal = picker.access.refusal(
            self.path,
            self._one("Host"),
            self._one("Origin"),
            self._one("Cookie"),
            picker.port,
            from_page=from_page,
        )
        if refusal is not None:
            self._refuse(*refusal)
            return False
        # Only the token tells a person from somebody else, who may send the rest of the request slowly.
        return self._settle() if picker.access.token or not from_page else True

    def _settle(self) -> bool:
        return self.server.connections.settle(self.connection)

    def _one(self, name: str) -> str | None:
        values = self.headers.get_all(name) or []
        return values[0] if len(values) == 1 else ("" if values else None)

    def _body(self) -> bytes | None:
        """The body of the request; None if it is refused."""
        told = self._one("Content-Length") or ""
        if not re.fullmatch(r"\d{1,12}", told) or self.headers.get("Transfer-Encoding"):
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "The request has no Content-Length.")
        elif self._one("Content-Type") != "application/json":
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "The request is not JSON.")
        elif int(told) > LARGEST_BODY:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "The request is too large.")
        else:
            body = self.rfile.read(int(told))
            # Else a browser went away in the middle.
            return body if len(body) == int(told) and self._settle() else None
        return None

    def _send_json(self, told: Any) -> None:
        self._send(HTTPStatus.OK, json.dumps(told).encode(), "application/json")

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        self._send(status, (reason + "\n").encode("utf-8", "replace"), "text/plain; charset=utf-8")

    def _send(self, status: HTTPStatus, body: bytes, kind: str = "text/plain", **headers: str) -> None:
        self.close_connection = True
        self.connection.settimeout(self.timeout)
        self.send_response(status)
        every = {**SAFE_HEADERS, "Content-Security-Policy": _POLICY, **headers}
        every |= {"Content-Type": kind, "Content-Length": str(len(body))}
        for name, value in every.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is printed; the token is in the address."""


def _listening(picker: Picker, host: str, port: int) -> _Server:
    for number in range(port, port + _PORTS if port else 1):
        try:
            return _Server((host, number), picker)
        except OSError as error:
            problem = error
    raise InputError(
        f"The page cannot be served on {host}, port {port}: {problem.strerror}; choose another --host or "
        "--port."
    )


def _nothing() -> None:
    pass


def _interrupt() -> None:
    """Do what Ctrl-C does."""
    if hasattr(signal, "pthread_kill") and (main := threading.main_thread().ident):
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()


def _describe(session: PickingSession) -> dict[str, Any]:
    frames = session.frames
    return {
        "source": session.source,
        "first": frames.start,
        "last": frames[-1],
        "step": frames.step,
        "width": session.width,
        "height": session.height,
        "tracker": session.config.tracker.name,
        "choices": setting_choices(session.config) if session.menu else None,
        "tracker_for": tracker_lines(),
        **_describe_settings(session),
    }


def _describe_settings(session: PickingSession) -> dict[str, Any]:
    """What is chosen, and what the settings come to that are not."""
    if session.menu is None:
        return {}
    return {"chosen": session.menu.chosen.model_dump(), "usual": settings_in_words(session.config)}
