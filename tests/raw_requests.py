"""Requests as no browser sends them."""

from __future__ import annotations

import socket


def raw_request(port: int, text: str | bytes, wait: float = 5.0) -> bytes:
    """Send bytes to a server on this machine, and give the beginning of what it answers; empty where it hangs up."""
    with socket.create_connection(("127.0.0.1", port), timeout=wait) as connection:
        try:
            connection.sendall(text.encode("latin-1") if isinstance(text, str) else text)
            return connection.recv(65536)
        except ConnectionError:
            return b""


def status(answer: bytes) -> int:
    """The status of an answer; 0 for none."""
    return int(answer.split()[1]) if answer.startswith(b"HTTP/") else 0


def request(method: str, path: str, body: bytes = b"", **headers: str) -> bytes:
    """A request of our own page, unless ``headers`` say otherwise; None for a name leaves it out."""
    told = {
        "Host": "127.0.0.1",
        "Connection": "close",
        **{k.replace("_", "-"): v for k, v in headers.items()},
    }
    if method == "POST":
        told = {
            "Origin": "http://127.0.0.1",
            "Content-Type": "application/json",
            "Content-Length": str(len(body)),
            **told,
        }
    lines = [f"{name}: {value}\r\n" for name, value in told.items() if value is not None]
    return f"{method} {path} HTTP/1.1\r\n{''.join(lines)}\r\n".encode("latin-1") + body
