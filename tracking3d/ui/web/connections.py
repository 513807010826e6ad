"""Connections of a server: a limit on their number that slow ones cannot use up, and on the time of a request."""

from __future__ import annotations

import io
import socket
import threading
import time
from contextlib import suppress
from typing import Any


class Connections:
    """The connections of a server, at most so many at a time.

    While a request is still arriving, its connection gives way to a newer one if there are too many: whoever sends
    slowly, or nothing, shuts nobody else out.

    Args:
        most: How many there may be.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._arriving: dict[socket.socket, None] = {}  # the oldest first
        self._settled: set[socket.socket] = set()

    def add(self, connection: socket.socket) -> bool:
        """Take a new connection; False if there are too many, all of which are worked on."""
        with self._lock:
            if len(self._arriving) + len(self._settled) >= self._most:
                if not self._arriving:
                    return False
                oldest = next(iter(self._arriving))
                del self._arriving[oldest]
                with suppress(OSError):  # it is gone
                    oldest.shutdown(socket.SHUT_RDWR)  # whoever reads from it finds its end
            self._arriving[connection] = None
            return True

    def settle(self, connection: socket.socket) -> bool:
        """From here on a connection gives way to none; False if it has done so already."""
        with self._lock:
            if connection in self._arriving:
                del self._arriving[connection]
                self._settled.add(connection)
            return connection in self._settled

    def remove(self, connection: socket.socket) -> None:
        """Forget a connection that has ended."""
        with self._lock:
            self._arriving.pop(connection, None)
            self._settled.discard(connection)


class TimedReader(io.RawIOBase):
    """What a connection brings within a time: a limit for all of it, as one for each read could go on for ever.

    Args:
        connection: The connection.
        seconds: The time from now on.
    """

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        self._connection, self._until = connection, time.monotonic() + seconds

    def readable(self) -> bool:
        """See `io.RawIOBase.readable`."""
        return True

    def readinto(self, buffer: Any) -> int:
        """See `io.RawIOBase.readinto`.

        Raises:
            TimeoutError: If the time is over.
            OSError: If the connection is broken.
        """
        left = self._until - time.monotonic()
        if left <= 0:
            raise TimeoutError("the request took too long to arrive")
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)
