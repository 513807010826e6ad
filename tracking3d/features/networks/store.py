"""Networks in the user's cache: the file of a name or path, and whether it is the known one.

The cache is in the platform's cache folder (``~/.cache/tracking3d`` on Linux); the environment variable
``TRACKING3D_CACHE`` chooses another.
"""

from __future__ import annotations

import hashlib
import os
from enum import StrEnum
from pathlib import Path

import platformdirs

from tracking3d.config.explain import nearest
from tracking3d.errors import InputError
from tracking3d.features.networks.catalogue import KnownNetwork, known_networks

VARIABLE = "TRACKING3D_CACHE"
"""Environment variable that names the cache folder."""

_CHUNK = 1 << 20


class State(StrEnum):
    """State of a known network in the cache."""

    ABSENT = "absent"
    OK = "ok"
    UNCHECKED = "unchecked"
    DAMAGED = "damaged"


def cache_folder() -> Path:
    """The user's cache folder of tracking3d; it need not exist."""
    if given := os.environ.get(VARIABLE):
        return Path(given).expanduser()
    return platformdirs.user_cache_path("tracking3d", appauthor=False)


def network_path(network: KnownNetwork) -> Path:
    """Path of a network in the cache, whether it exists or not."""
    return cache_folder() / "models" / network.file


def find_network(name: str | Path) -> Path:
    """The ONNX file that ``name`` means.

    Args:
        name: The path of a file, or the name of a known network, see ``tracking3d models list``.

    Raises:
        InputError: There is no such file, or the network is known but not in the cache.
    """
    file = Path(name).expanduser()
    if file.is_file():
        return file
    if str(name) not in known_networks() and (file.suffix.lower() == ".onnx" or len(file.parts) > 1):
        raise InputError(
            f"The network {name} does not exist; give the path of an ONNX file, or a name that "
            "`tracking3d models list` shows."
        )
    network = find_known(str(name))
    path = network_path(network)
    if not path.is_file():
        raise InputError(
            f"The network {network.name} is not in {path.parent}; download it with "
            f"`tracking3d models get {network.name}`, or give the path of an ONNX file."
        )
    return path


def find_known(name: str) -> KnownNetwork:
    """The catalogue entry of a name.

    Raises:
        InputError: There is none; the message has the nearest name.
    """
    networks = known_networks()
    if name in networks:
        return networks[name]
    best = nearest(name, networks)
    advice = f"did you mean '{best}'?" if best else "`tracking3d models list` shows the known ones."
    raise InputError(f"There is no known network '{name}'; {advice}")


def state_of(network: KnownNetwork, *, check: bool = True) -> State:
    """Whether a network is in the cache, and whether its file matches the catalogue.

    Args:
        network: The network.
        check: Read the file and compare its hash; if false, an existing file counts as unchecked.

    Raises:
        InputError: Its file cannot be read.
    """
    path = network_path(network)
    if not path.is_file():
        return State.ABSENT
    if network.sha256 is None or not check:
        return State.UNCHECKED
    return State.OK if sha256_of(path) == network.sha256 else State.DAMAGED


def sha256_of(file: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        InputError: It cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with file.open("rb") as stream:
            while chunk := stream.read(_CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror or error}.") from error
    return digest.hexdigest()
