"""The catalogue of known networks: purpose, address, size, SHA-256 and licence."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError, model_validator

from tracking3d.config.explain import describe_validation_error, hint
from tracking3d.config.loading import read_mapping
from tracking3d.config.models import Section
from tracking3d.errors import InputError


class NpmPackage(Section):
    """Where a package of npm holds a network; the client `npm` knows from where to download it."""

    name: str = Field(pattern=r"^[a-z0-9-]+@[0-9.]+$", description="Package and version.")
    integrity: str = Field(pattern="^sha512-", description="As npm publishes it, of the whole package.")
    member: str = Field(pattern=r"^package/[\w./-]+\.onnx$", description="The network's file in the package.")


class KnownNetwork(Section):
    """One entry of the catalogue."""

    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9.-]*$", description="Selects it, wherever a network is given."
    )
    purpose: str = Field(description="What the network does, and what uses it.")
    licence: str = Field(description="SPDX identifier, or the name of the licence.")
    authors: str = Field(pattern="^https://", description="Page on which its authors publish it.")
    address: str | None = Field(
        None,
        pattern="^https?://",
        description="Address of exactly this file; null if none is known for sure.",
    )
    mirrors: tuple[str, ...] = Field(
        (), description="Other addresses of the same bytes, in the order to try them."
    )
    npm: NpmPackage | None = Field(None, description="Package that holds it, if there is no address.")
    size: int | None = Field(None, gt=0, description="Bytes.")
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")
    non_commercial: bool = Field(False, description="Whether its licence forbids commercial use.")
    how: str = Field("", description="How to obtain the file, if there is no address.")
    recommended: bool = Field(
        False, description="Whether it is one of those that make masks better at little cost."
    )

    @model_validator(mode="after")
    def _validate_origin(self) -> KnownNetwork:
        if self.address is not None and (self.sha256 is None or self.size is None):
            raise ValueError("an address needs a size and a sha256, because downloads are checked")
        if self.address is None and self.mirrors:
            raise ValueError("mirrors are further addresses; give the first one as address")
        if any(not mirror.startswith(("http://", "https://")) for mirror in self.mirrors):
            raise ValueError("mirrors begin with http:// or https://")
        if self.address is None and self.recommended:
            raise ValueError("a network without an address cannot be recommended")
        if self.is_exported and not self.how:
            raise ValueError("without an address, how must explain how to obtain the file")
        return self

    @property
    def is_exported(self) -> bool:
        """Whether everybody has to export it, because no file of it is published."""
        return self.address is None and self.npm is None

    @property
    def addresses(self) -> tuple[str, ...]:
        """Download addresses, in the order to try."""
        return () if self.address is None else (self.address, *self.mirrors)

    @property
    def file(self) -> str:
        """Name of its file in the cache."""
        return f"{self.name}.onnx"


def known_networks() -> dict[str, KnownNetwork]:
    """Every known network by name, in the catalogue's order."""
    with resources.as_file(resources.files(__package__) / "catalogue.yaml") as file:
        return read_catalogue(file)


def recommended_networks() -> list[KnownNetwork]:
    """The networks that the tracker ``auto`` uses best, of those that can be downloaded."""
    return [network for network in known_networks().values() if network.recommended]


def read_catalogue(file: Path) -> dict[str, KnownNetwork]:
    """Read a catalogue: a YAML mapping from names to entries.

    Raises:
        InputError: It cannot be read, or an entry is incomplete.
    """
    networks = {}
    for name, entry in read_mapping(file).items():
        try:
            networks[name] = KnownNetwork.model_validate({"name": name, **(entry or {})})
        except (ValidationError, TypeError) as error:
            reason = str(error)
            if isinstance(error, ValidationError):
                reason = describe_validation_error(error, KnownNetwork, "key")
            raise InputError(f"{file}, network '{name}': {reason}") from error
    return networks


def description_names(package: str) -> list[str]:
    """Names of the descriptions that come with a package, in its folder ``descriptions``."""
    folder = resources.files(package) / "descriptions"
    return sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(".yaml"))


def read_description(name: str | Path, package: str, noun: str) -> tuple[Path, dict[str, Any]]:
    """Read a description that comes with a package, or one of the user.

    Args:
        name: Name of one of the package's, or a YAML file.
        package: The package, such as ``tracking3d.features.onnx``.
        noun: Word for what is described, in messages.

    Returns:
        The file, and its keys, not validated yet.

    Raises:
        InputError: There is no such description, or it is not a YAML mapping.
    """
    names = description_names(package)
    if str(name) in names:
        with resources.as_file(resources.files(package) / "descriptions" / f"{name}.yaml") as file:
            return file, dict(read_mapping(file))
    file = Path(name).expanduser()
    if not file.is_file():
        raise InputError(
            f"There is no {noun} '{name}'; give a YAML file or one of {', '.join(names)}: "
            f"{hint(str(name), names)}"
        )
    return file, dict(read_mapping(file))
