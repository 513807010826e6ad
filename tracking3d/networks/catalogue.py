"""The networks that are known by name: what for, where from, how large, which SHA-256, which licence."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pydantic import Field, ValidationError, model_validator

from tracking3d.config.explain import describe_validation_error
from tracking3d.config.models import Section
from tracking3d.config.yaml_files import read_mapping
from tracking3d.errors import InputError


class KnownNetwork(Section):
    """One entry of the catalogue.

    Attributes:
        name: What selects it, here and wherever a network is asked for.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9.-]*$")
    purpose: str = Field(description="What it is and what it is for.")
    licence: str = Field(description="SPDX identifier or the licence's own name.")
    authors: str = Field(pattern="^https://", description="Where its authors publish it.")
    address: str | None = Field(
        None,
        pattern="^https?://",
        description="Address of the very file; none where that is not known for sure.",
    )
    mirrors: tuple[str, ...] = Field(
        (), description="Other addresses of the same bytes, in the order to try them."
    )
    size: int | None = Field(None, gt=0, description="Bytes.")
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")
    non_commercial: bool = Field(False, description="Whether its licence forbids commercial use.")
    how: str = Field("", description="Without an address: how to come by the file.")

    @model_validator(mode="after")
    def _fetched_or_explained(self) -> KnownNetwork:
        if self.address is not None and (self.sha256 is None or self.size is None):
            raise ValueError("an address needs a size and a sha256, for what is fetched is checked")
        if self.address is None and self.mirrors:
            raise ValueError("mirrors are further addresses; give the first one as address")
        if any(not mirror.startswith(("http://", "https://")) for mirror in self.mirrors):
            raise ValueError("mirrors begin with http:// or https://")
        if self.address is None and not self.how:
            raise ValueError("without an address it must say how to come by the file")
        return self

    @property
    def addresses(self) -> tuple[str, ...]:
        """Where it can be fetched, in the order to try."""
        return () if self.address is None else (self.address, *self.mirrors)

    @property
    def file(self) -> str:
        """Name of its file in the cache."""
        return f"{self.name}.onnx"


def known_networks() -> dict[str, KnownNetwork]:
    """Every known network by name, in the catalogue's order."""
    with resources.as_file(resources.files(__package__) / "catalogue.yaml") as file:
        return read_catalogue(file)


def read_catalogue(file: Path) -> dict[str, KnownNetwork]:
    """Read a catalogue: a YAML mapping from names to entries.

    Raises:
        InputError: If it cannot be read, or an entry is not complete.
    """
    networks = {}
    for name, entry in read_mapping(file).items():
        try:
            networks[name] = KnownNetwork.model_validate({"name": name, **(entry or {})})
        except (ValidationError, TypeError) as error:
            told = (
                describe_validation_error(error, KnownNetwork, "key")
                if isinstance(error, ValidationError)
                else str(error)
            )
            raise InputError(f"{file}, network '{name}': {told}") from error
    return networks
