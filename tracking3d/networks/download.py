"""Known networks into the cache: from their address, or from a file that was fetched elsewhere.

What arrives is written beside its place, compared with the catalogue's SHA-256 and only then renamed into place:
whatever goes wrong, nothing half or wrong is left. Files are never unpickled, and nothing in them is run.
"""

from __future__ import annotations

import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedRandom
from pathlib import Path
from typing import IO

from tracking3d.errors import InputError, OutputError
from tracking3d.networks.catalogue import KnownNetwork
from tracking3d.networks.session import Network
from tracking3d.networks.store import VARIABLE, network_path, sha256_of

Listener = Callable[[int], None]
"""Is told how many bytes have arrived since the last call."""

_CHUNK = 1 << 18
_PATIENCE = 30.0
"""Seconds without a byte after which the other side counts as silent."""


def fetch(
    network: KnownNetwork, *, accept_licence: bool = False, listener: Listener = lambda count: None
) -> Path:
    """Download a known network into the cache, replacing what is there.

    Args:
        network: The network.
        accept_licence: Whether the user accepts a licence that forbids commercial use.
        listener: Is told of the bytes as they arrive.

    Returns:
        The file in the cache.

    Raises:
        InputError: If its licence is not accepted, its address is not known or cannot be reached, or other bytes
            arrive than the catalogue knows. The message says what to download and where to put it.
        OutputError: If the cache cannot be written.
    """
    _check_licence(network, accept_licence)
    if network.address is None:
        raise InputError(
            f"{network.name} cannot be fetched: {network.how} ({network.authors}), {_by_hand(network)}."
        )
    request = urllib.request.Request(network.address, headers={"User-Agent": "tracking3d"})
    with _arriving(network) as part:
        try:
            with urllib.request.urlopen(request, timeout=_PATIENCE) as response:
                count = _copy(response, part, network.size, listener)
        except urllib.error.HTTPError as error:
            error.close()
            raise _unreachable(network, f"the server answered {error.code} {error.reason}") from error
        except (OSError, http.client.HTTPException) as error:
            raise _unreachable(network, _told(error)) from error
        if network.size and count < network.size:
            raise _unreachable(network, f"the connection broke off after {count} of {network.size} bytes")
        _check(network, Path(part.name), f"what {network.address} gave", f"; {_instead(network)}")
    return network_path(network)


def adopt(network: KnownNetwork, file: Path, *, accept_licence: bool = False) -> Path:
    """Copy a network that was fetched elsewhere into the cache, replacing what is there.

    Args:
        network: The network that the file is.
        file: The file.
        accept_licence: Whether the user accepts a licence that forbids commercial use.

    Returns:
        The file in the cache.

    Raises:
        InputError: If the licence is not accepted, the file cannot be read, is not what the catalogue knows, or,
            where no hash is known, is no ONNX network.
        OutputError: If the cache cannot be written.
    """
    _check_licence(network, accept_licence)
    file = file.expanduser()
    try:
        source = file.open("rb")
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror or error}.") from error
    with source, _arriving(network) as part:
        _copy(source, part, network.size, lambda count: None)
        own = "; a network that you exported yourself is used by its path and needs no name"
        _check(network, Path(part.name), str(file), own)
        if network.sha256 is None:
            try:
                Network(Path(part.name))
            except InputError as error:
                raise InputError(
                    f"{file} is not a network that onnxruntime can run; {network.how} ({network.authors})."
                ) from error
    return network_path(network)


def _check_licence(network: KnownNetwork, accepted: bool) -> None:
    if network.non_commercial and not accepted:
        raise InputError(
            f"The licence of {network.name}, {network.licence}, forbids commercial use: read it at "
            f"{network.authors} and add --accept-licence if you accept it."
        )


@contextmanager
def _arriving(network: KnownNetwork) -> Iterator[BufferedRandom]:
    """A file beside the network's place; renamed there if the block ends well, and gone if it does not."""
    path = network_path(network)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = partial.open("w+b")
    try:
        with part:
            yield part
        with _writing(path):
            partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _copy(source: IO[bytes], part: BufferedRandom, size: int | None, listener: Listener) -> int:
    """Copy the bytes and count them; more than ``size`` are not copied to the end."""
    count = 0
    while (size is None or count <= size) and (chunk := source.read(_CHUNK)):
        with _writing(Path(part.name)):
            part.write(chunk)
        count += len(chunk)
        listener(len(chunk))
    with _writing(Path(part.name)):
        part.flush()
    return count


def _check(network: KnownNetwork, file: Path, origin: str, advice: str) -> None:
    """Compare a file with what the catalogue knows of the network.

    Raises:
        InputError: If they differ.
    """
    size = file.stat().st_size
    if network.size is not None and size != network.size:
        many = (
            f"more than {network.size} bytes"
            if size > network.size
            else f"{size} instead of {network.size} bytes"
        )
        raise InputError(f"{origin} is not {network.name}: it has {many}{advice}.")
    if network.sha256 is not None and (found := sha256_of(file)) != network.sha256:
        raise InputError(
            f"{origin} is not {network.name}: its SHA-256 is {found} instead of {network.sha256}{advice}."
        )


def _unreachable(network: KnownNetwork, reason: str) -> InputError:
    return InputError(f"{network.name} could not be fetched ({reason}): {_instead(network)}.")


def _instead(network: KnownNetwork) -> str:
    return f"download {network.address} elsewhere, {_by_hand(network)}"


def _by_hand(network: KnownNetwork) -> str:
    """What to do with a file that came another way."""
    keep = f"`tracking3d models get {network.name} --from FILE` or put it at {network_path(network)}"
    if network.address is None and network.sha256 is not None:  # every export has other bytes
        return f"and use your file by its path; if you have the one with SHA-256 {network.sha256}, {keep}"
    return f"then {keep}"


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written: {error.strerror or error}; make room there, or name another folder with "
            f"the environment variable {VARIABLE}."
        ) from error


def _told(error: object) -> str:
    """The reason of a failed connection in a few words."""
    if isinstance(error, urllib.error.URLError):
        return _told(error.reason)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
