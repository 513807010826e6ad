"""What a feature network takes and gives: a short YAML description that users can write themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from tracking3d.config.explain import describe_validation_error
from tracking3d.config.models import Section
from tracking3d.errors import InputError
from tracking3d.networks.descriptions import description_names, read_description

PACKAGE = "tracking3d.features.onnx"
"""Whose folder ``descriptions`` holds those that come along."""

Triple = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class NetworkInput(Section):
    """How an image becomes a network's input: RGB in [0, 1] scaled, the mean removed, divided by the deviation."""

    name: str | None = Field(None, description="The input's name; the network's only one if not given.")
    scale: float = Field(1.0, gt=0, description="The image is multiplied by it first: 1 or 255.")
    mean: Triple = Field((0.0, 0.0, 0.0), description="Subtracted after that: red, green, blue.")
    std: tuple[Positive, Positive, Positive] = Field(
        (1.0, 1.0, 1.0), description="Divided by after that: red, green, blue."
    )
    channels: Literal["rgb", "bgr"] = Field("rgb", description="Order of the channels.")
    multiple: int = Field(
        32,
        ge=1,
        le=1024,
        description="Height and width must be multiples of it, unless the network fixes them.",
    )
    fit: Literal["pad", "resize"] = Field(
        "pad",
        description="How sizes become multiples: the border repeated at the right and below, or by resizing.",
    )


class EncoderDescription(Section):
    """A dense feature network. Without any key it is what most are: RGB in [0, 1], one map, unit length."""

    title: str = Field("", description="What it is, for readers.")
    link: str = Field("", description="Where it comes from, for readers.")
    input: NetworkInput = NetworkInput()
    output: str | tuple[str, ...] | None = Field(
        None, description="The feature map, or several; the one with the most channels if not given."
    )
    combine: Literal["concatenate", "sum"] = Field(
        "concatenate", description="What becomes of several maps, after they have the size of the result."
    )
    stride: int | None = Field(
        None,
        ge=1,
        le=256,
        description="Image pixels per feature pixel; as the (first) map has it if not given.",
    )
    normalise: Literal["unit", "each", "none"] = Field(
        "unit",
        description="Features of unit length; each of several maps first and then all; or as they are.",
    )
    tau: float = Field(0.05, gt=0, description="Appearance loss below which a frame counts as explained.")

    @property
    def outputs(self) -> tuple[str, ...]:
        """The outputs that are named."""
        return (self.output,) if isinstance(self.output, str) else self.output or ()


def load_encoder_description(name: str | Path) -> EncoderDescription:
    """Read a description.

    Args:
        name: Of one that comes with the package, or a YAML file.

    Raises:
        InputError: If there is no such description, or a key or value in it cannot be used.
    """
    file, keys = read_description(name, PACKAGE, "description of a feature network")
    try:
        return EncoderDescription.model_validate(keys)
    except ValidationError as error:
        raise InputError(f"{file}: {describe_validation_error(error, EncoderDescription, 'key')}") from error


def builtin_encoder_descriptions() -> list[str]:
    """Names of the descriptions that come with the package."""
    return description_names(PACKAGE)
