"""A file over HTTP into one that has its beginning already: ranges, silence, broken connections, proxies.

Proxies are those of the environment (``http_proxy``, ``https_proxy``, ``no_proxy``), as `urllib` reads them.
"""

from __future__ import annotations

import http.client
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from io import BufferedRandom

Listener = Callable[[int], None]
"""Is told how many bytes have arrived since the last call; fewer than none where it begins anew."""

_CHUNK = 1 << 18
_PATIENCE = 30.0
"""Seconds without a byte after which the other side counts as silent."""


class TransferError(Exception):
    """An address gave nothing, or not everything; the message says why in a few words."""


def transfer(
    address: str, part: BufferedRandom, size: int, write: Callable[[bytes], None], listener: Listener
) -> None:
    """Go on with ``part`` until it has ``size`` bytes; what is more is not read to its end.

    A connection that breaks off is taken up again where it broke, as long as every one of them brings something.

    Args:
        address: ``http`` or ``https``.
        part: What has arrived before, which may be nothing.
        size: How many bytes there should be in the end.
        write: Appends to ``part``; an error of the disk is the caller's to tell.
        listener: Is told of the bytes as they arrive.

    Raises:
        TransferError: If the address cannot be reached, answers with an error, or stops bringing anything.
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
            raise TransferError(f"the server answered {error.code} {error.reason}") from error
        except http.client.IncompleteRead as error:
            write(error.partial)
            listener(len(error.partial))
        except (OSError, http.client.HTTPException) as error:
            broken = describe_connection_error(error)
        if (count := part.tell()) < size and count <= before:
            raise TransferError(broken or f"the connection broke off after {count} of {size} bytes")


def _answer(address: str, before: int) -> http.client.HTTPResponse:
    headers = {"User-Agent": "tracking3d", **({"Range": f"bytes={before}-"} if before else {})}
    request = urllib.request.Request(address, headers=headers)
    opener = urllib.request.build_opener()  # reads the proxies of now; urlopen those of its first call
    response: http.client.HTTPResponse = opener.open(request, timeout=_PATIENCE)
    return response


def _goes_on(response: http.client.HTTPResponse, before: int) -> bool:
    """Whether a server gives the rest, and not the whole file once more."""
    given = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    return response.status == http.client.PARTIAL_CONTENT and given is not None and int(given[1]) == before


def describe_connection_error(error: object) -> str:
    """The reason of a failed connection in a few words."""
    if isinstance(error, urllib.error.URLError):
        return describe_connection_error(error.reason)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
