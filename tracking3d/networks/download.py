"""Download known networks into the cache, or copy a file that was downloaded elsewhere.

A download is written to a temporary file, compared with the SHA-256 of the catalogue, and only then renamed: the cache
never holds an incomplete or wrong file. The next download continues a stopped one. Files are never unpickled, and
nothing in them is executed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedRandom
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from tracking3d.errors import InputError, OutputError
from tracking3d.networks.catalogue import KnownNetwork
from tracking3d.networks.store import VARIABLE, network_path, sha256_of
from tracking3d.networks.transfer import Listener, TransferError, transfer

_CHUNK = 1 << 18


def fetch(
    network: KnownNetwork,
    *,
    accept_licence: bool = False,
    listener: Listener = lambda count: None,
    mirror: str | None = None,
) -> Path:
    """Download a known network into the cache, replacing an existing file.

    Its addresses are tried in order until one returns the known bytes. A stopped download is continued.

    Args:
        network: The network.
        accept_licence: Whether the user accepts a licence that forbids commercial use.
        listener: Called with the number of new bytes.
        mirror: Address of a folder that holds ``NAME.onnx``; tried before all others.

    Returns:
        The file in the cache.

    Raises:
        InputError: Its licence is not accepted, no address is known or can be reached, or the bytes differ from the
            catalogue. The message says what to download and where to put it.
        OutputError: The cache cannot be written.
    """
    _check_licence(network, accept_licence)
    addresses = network.addresses
    if mirror is not None:
        addresses = (_in_mirror(network, mirror), *addresses)
    if not addresses:
        raise InputError(
            f"{network.name} cannot be downloaded: {network.how} ({network.authors}), {_by_hand(network)}."
        )
    with _arriving(network, keep=True) as part:
        reasons: dict[str, str] = {}
        for address in addresses:
            if not (reason := _fetch_from(address, network, part, listener)):
                break
            reasons[address] = reason
        else:
            alike = len(set(reasons.values())) == 1
            every = [f"{one}: {why}" for one, why in reasons.items()]
            why = (
                reason
                if len(every) == 1
                else f"{', '.join(reasons)}: {reason}"
                if alike
                else "; ".join(every)
            )
            raise InputError(
                f"{network.name} could not be downloaded ({why}): download {addresses[-1]} elsewhere, "
                f"{_by_hand(network)}."
            )
    return network_path(network)


def _in_mirror(network: KnownNetwork, mirror: str) -> str:
    try:
        address = urlsplit(mirror)
        valid = address.scheme in ("http", "https") and bool(address.hostname) and address.port != 0
    except ValueError:  # brackets that do not match, or a port that is no number
        valid = False
    if not valid:
        raise InputError(
            f"The mirror {mirror} is not an address; give one such as https://example.org/networks."
        )
    if network.sha256 is None or network.size is None:
        raise InputError(
            f"{network.name} cannot be downloaded from a mirror, because its SHA-256 is unknown: {network.how} "
            f"({network.authors}), {_by_hand(network)}."
        )
    return f"{mirror.rstrip('/')}/{network.file}"


def _fetch_from(address: str, network: KnownNetwork, part: BufferedRandom, listener: Listener) -> str:
    """Download the network from one address into ``part``; returns why that failed, or an empty text.

    If the rest of an earlier download does not fit, everything is downloaded again.
    """
    size = network.size or 0
    kept = part.seek(0, 2)
    listener(kept)
    while True:
        try:
            transfer(address, part, size, lambda chunk: _write(part, chunk), listener)
        except TransferError as error:
            listener(-part.tell())
            return str(error)
        with _writing(Path(part.name)):
            part.flush()
        difference = _difference(network, Path(part.name))
        if not difference:
            return ""
        listener(-part.tell())
        part.truncate(0)
        if not kept:
            return f"the file from {address} {difference}"
        kept = 0


def adopt(network: KnownNetwork, file: Path, *, accept_licence: bool = False) -> Path:
    """Copy a network that was downloaded elsewhere into the cache, replacing an existing file.

    Args:
        network: The network in the file.
        file: The file.
        accept_licence: Whether the user accepts a licence that forbids commercial use.

    Returns:
        The file in the cache.

    Raises:
        InputError: The licence is not accepted, the file cannot be read, it differs from the catalogue, or, if no hash
            is known, it is not an ONNX network.
        OutputError: The cache cannot be written.
    """
    _check_licence(network, accept_licence)
    file = file.expanduser()
    try:
        source = file.open("rb")
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror or error}.") from error
    with source, _arriving(network) as part:
        _copy(source, part, network.size)
        if difference := _difference(network, Path(part.name)):
            raise InputError(
                f"{file} {difference}; to use a network that you exported yourself, give its path instead of a name."
            )
        if network.sha256 is None:
            try:
                from tracking3d.networks.session import Network  # slow to import

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
def _arriving(network: KnownNetwork, keep: bool = False) -> Iterator[BufferedRandom]:
    """A temporary file, which is renamed to the network's path if the block succeeds, and else removed.

    Args:
        network: The network.
        keep: Continue the file that an earlier block left, and leave it to a later one. Only one block uses the file:
            a concurrent download of the same network starts a file of its own.
    """
    path = network_path(network)
    own = path.with_name(f".{path.name}.{os.getpid()}")
    kept = path.with_name(f".{path.name}.{(network.sha256 or '')[:12]}.part")
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if keep:
            with suppress(FileNotFoundError):
                kept.replace(own)
        part = own.open("r+b" if own.exists() and keep else "w+b")
    try:
        with part:
            yield part
        with _writing(path):
            own.replace(path)
    finally:
        if keep and own.exists() and own.stat().st_size:
            own.replace(kept)
        own.unlink(missing_ok=True)


def _write(part: BufferedRandom, chunk: bytes) -> None:
    with _writing(Path(part.name)):
        part.write(chunk)


def _difference(network: KnownNetwork, file: Path) -> str:
    """How a file differs from the catalogue, as the end of a sentence; empty if it does not."""
    size = file.stat().st_size
    if network.size is not None and size != network.size:
        most = f"more than {network.size}" if size > network.size else f"{size} instead of {network.size}"
        return f"is not {network.name}: it has {most} bytes"
    if network.sha256 is not None and (found := sha256_of(file)) != network.sha256:
        return f"is not {network.name}: its SHA-256 is {found} instead of {network.sha256}"
    return ""


def _copy(source: IO[bytes], part: BufferedRandom, size: int | None) -> None:
    """Copy the bytes, and stop once there are more than ``size``."""
    while (size is None or part.tell() <= size) and (chunk := source.read(_CHUNK)):
        _write(part, chunk)
    with _writing(Path(part.name)):
        part.flush()


def _by_hand(network: KnownNetwork) -> str:
    """Advice on how to add the file by hand."""
    keep = f"`tracking3d models get {network.name} --from FILE` or put it at {network_path(network)}"
    if network.address is None and network.sha256 is not None:  # every export has different bytes
        return f"and give the path of your file; if its SHA-256 is {network.sha256}, {keep}"
    return f"then {keep}"


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written: {error.strerror or error}; free some space, or choose another folder with "
            f"the environment variable {VARIABLE}."
        ) from error
