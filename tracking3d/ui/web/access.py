"""Access control of served pages: the check that every request passes first.

A page on this machine is reached by every other page that is open in the same browser, unless it looks at two
headers. ``Host`` is the name that the browser asked for: a stranger's name that was pointed at this machine (DNS
rebinding) is not one of ours. ``Origin`` is the page that asks: another one than ours may not. On a host that others
can reach, a token is needed besides; it comes once, in the address that is printed, and then in a cookie.
"""

from __future__ import annotations

import hmac
import re
import secrets
import socket
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import NamedTuple, Self
from urllib.parse import parse_qs, urlsplit

from tracking3d.errors import InputError

LOOPBACK = "127.0.0.1"
_OUR_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
_PORT = re.compile(r":\d{1,5}$")
_LONGEST = 4096  # characters of a header or a path that are looked at

SAFE_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every response: not cached, not framed, and the address, which may hold the token, is not sent as
referrer."""


class Refusal(NamedTuple):
    """Why a request is refused."""

    status: HTTPStatus
    reason: str  # for the person who sees it


@dataclass(frozen=True)
class Access:
    """Where a server listens, and whom it serves."""

    host: str = LOOPBACK  # the address that it listens on
    # what has to be known besides; empty where only this machine can connect
    token: str = field(default="", repr=False)

    @classmethod
    def on(cls, host: str | None) -> Self:
        """This machine only where ``host`` is None, else ``host``, with a new token.

        Raises:
            InputError: If this machine cannot listen on ``host``.
        """
        if host is None:
            return cls()
        _check_own(host)
        return cls(host, secrets.token_urlsafe(24))

    def address(self, port: int) -> str:
        """What to open in the browser, the token included."""
        name = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{name}:{port}/" + (f"?token={self.token}" if self.token else "")

    def cookie(self, port: int) -> str:
        """The header that lets the browser come back without the token in its address."""
        return f"{_cookie_name(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def refusal(
        self,
        path: str,
        host: str | None,
        origin: str | None,
        cookie: str | None,
        port: int,
        *,
        from_page: bool,
    ) -> Refusal | None:
        """Why a request is refused; None where it is not.

        Args:
            path: What is asked for, the query included.
            host: The header ``Host``.
            origin: The header ``Origin``.
            cookie: The header ``Cookie``.
            port: The port that the server listens on.
            from_page: Whether only a page of ours asks for it: a web socket, or whatever changes something. A browser
                then always tells its ``Origin``.
        """
        told = [text for text in (path, host, origin, cookie) if text is not None]
        if any(len(text) > _LONGEST for text in told):
            return Refusal(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "A header of the request is too long.")
        if not host or (not self.token and _name(host) not in _OUR_NAMES):
            return Refusal(HTTPStatus.FORBIDDEN, "The server is not known by this host name.")
        if (origin is None and from_page) or (origin is not None and not _same(origin, host)):
            return Refusal(HTTPStatus.FORBIDDEN, "Only the server's own page may request this.")
        if self.token and not (self.gives_token(path) or self._matches(_in_cookie(cookie, port))):
            return Refusal(
                HTTPStatus.UNAUTHORIZED,
                "Open the printed address, including its token, to see this page.",
            )
        return None

    def gives_token(self, path: str) -> bool:
        """Whether the token is in the query of ``path``."""
        return bool(self.token) and self._matches(_in_query(path))

    def _matches(self, told: str) -> bool:
        # In constant time, so that nobody finds the token letter by letter.
        return hmac.compare_digest(told.encode("utf-8", "replace"), self.token.encode())


def _check_own(host: str) -> None:
    """Make sure that a server can listen there; one that cannot may try for ever."""
    try:
        family, *_, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind(place)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"--host {host} is not an address of this machine ({error}); 0.0.0.0 means all of them."
        ) from error


def _name(host: str) -> str:
    return _PORT.sub("", host).strip("[]").lower()


def _same(origin: str, host: str) -> bool:
    """Whether a page of ``origin`` was served under the name and port of ``host``."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


def _in_query(path: str) -> str:
    try:
        return parse_qs(urlsplit(path).query, max_num_fields=16).get("token", [""])[0]
    except ValueError:
        return ""


def _in_cookie(header: str | None, port: int) -> str:
    try:
        morsel = SimpleCookie(header or "").get(_cookie_name(port))
    except CookieError:
        return ""
    return morsel.value if morsel else ""


def _cookie_name(port: int) -> str:
    # Cookies are shared by all ports of a host; each server has its own.
    return f"tracking3d_{port}"
