"""Download a file over HTTP, and continue a partial one: ranges, timeouts, broken connections, proxies.

Proxies are read from the environment (``http_proxy``, ``https_proxy``, ``no_proxy``), as `urllib` reads them.
"""

from __future__ import annotations

import http.client
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from io import BufferedRandom

Listener = Callable[[int], None]
"""Called with the number of new bytes; negative if the download starts again."""

_CHUNK = 1 << 18
_PATIENCE = 30.0
"""Timeout in seconds without a byte."""


class TransferError(Exception):
    """A download failed or is incomplete; the message says why in a few words."""


def transfer(
    address: str, part: BufferedRandom, size: int, write: Callable[[bytes], None], listener: Listener
) -> None:
    """Continue ``part`` until it has ``size`` bytes; stops reading if there are more.

    A broken connection is opened again where it broke, as long as every connection brings new bytes.

    Args:
        address: ``http`` or ``https``.
        part: The bytes of an earlier download, which may be none.
        size: Expected number of bytes.
        write: Appends to ``part``; the caller reports disk errors.
        listener: Called with the number of new bytes.

    Raises:
        TransferError: The address cannot be reached, returns an error, or stops sending.
    """
    ranges = True
    while (before := part.seek(0, 2)) < size:
        broken = ""
        try:
            with _answer(address, before if ranges else 0) as response:
                if before and not _goes_on(response, before):
                    part.truncate(0)
                    listener(-before)
                    part.seek(0)
                while part.tell() <= size and (chunk := response.read(_CHUNK)):
                    write(chunk)
                    listener(len(chunk))
        except urllib.error.HTTPError as error:
            error.close()
            if ranges and error.code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
                ranges = False
                continue
            raise TransferError(f"the server returned {error.code} {error.reason}") from error
        except http.client.IncompleteRead as error:
            write(error.partial)
            listener(len(error.partial))
        except (OSError, http.client.HTTPException) as error:
            broken = describe_connection_error(error)
        if (count := part.tell()) < size and count <= before:
            raise TransferError(broken or f"the connection broke after {count} of {size} bytes")


def _answer(address: str, before: int) -> http.client.HTTPResponse:
    headers = {"User-Agent": "tracking3d", **({"Range": f"bytes={before}-"} if before else {})}
    request = urllib.request.Request(address, headers=headers)
    opener = urllib.request.build_opener()  # reads the present proxies; urlopen keeps those of its first call
    response: http.client.HTTPResponse = opener.open(request, timeout=_PATIENCE)
    return response


def _goes_on(response: http.client.HTTPResponse, before: int) -> bool:
    """Whether a server sends the rest, and not the whole file again."""
    given = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    return response.status == http.client.PARTIAL_CONTENT and given is not None and int(given[1]) == before


def describe_connection_error(error: object) -> str:
    """The reason for a failed connection in a few words."""
    if isinstance(error, urllib.error.URLError):
        return describe_connection_error(error.reason)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
