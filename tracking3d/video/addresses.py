"""What the name of a source is: a path, a pattern of images, a camera number or an address."""

from __future__ import annotations

import glob
import re
from pathlib import Path

from tracking3d.errors import InputError

SCHEMES = ("http", "https", "rtsp", "rtsps")
"""Schemes of supported addresses."""

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):")


def scheme_of(name: str) -> str | None:
    """The scheme of an address, in small letters; None of what is no address, such as a path."""
    found = _SCHEME.match(name)
    return found[1].lower() if found else None


def without_password(address: str) -> str:
    """An address without the user's name and password, as messages and records have it; a path as it is."""
    if scheme_of(address) not in SCHEMES:
        return address
    scheme, slashes, rest = address.partition("//")
    server, slash, path = rest.partition("/")
    return "".join((scheme, slashes, server.rpartition("@")[2], slash, path))


def check_source_name(name: str) -> None:
    """Make sure that a name can be that of a source: it exists as a path, or is a pattern, a camera or an address.

    Raises:
        InputError: It is none of these.
    """
    if not name.strip():
        raise InputError(
            "The source is empty; give a video file, a folder or pattern of images, or a camera number."
        )
    try:
        exists = Path(name).expanduser().exists()
    except (OSError, ValueError) as error:  # no permission; a name that no file can have
        raise InputError(f"{name} cannot be opened: {getattr(error, 'strerror', None) or error}.") from error
    scheme = scheme_of(name)
    if exists or glob.has_magic(name) or (name.isascii() and name.isdigit()) or scheme in SCHEMES:
        return
    if scheme is not None:
        raise InputError(
            f"{name} does not exist, and addresses with {scheme}: are not supported; give a path, or an "
            f"address that begins with {', '.join(SCHEMES[:-1])} or {SCHEMES[-1]}."
        )
    raise InputError(
        f"{name} does not exist; give a video file, a folder or pattern of images, or a camera number."
    )
