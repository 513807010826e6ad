"""Feature encoder ``onnx``: any dense network in an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor
from torch.nn import functional

from tracking3d.config.explain import describe_validation_error
from tracking3d.config.models import Section
from tracking3d.errors import InputError
from tracking3d.features.networks.catalogue import read_description
from tracking3d.features.networks.session import Network, TensorInfo
from tracking3d.features.networks.store import find_network

_HOW_TO = "describe the network in a YAML file and set features.description to it"
_TRIAL_SIDE = 64  # pixels, enlarged to a multiple of what the network wants


class OnnxEncoder:
    """Encoder ``onnx``: a network in an ONNX file, and a description of what it takes and gives.

    Args:
        network: The network.
        description: What it takes and gives.

    Attributes:
        channels: Channels of the features, found by running the network once on zeros.
        stride: Image pixels per feature pixel.
        tau: Convergence threshold of the appearance loss.

    Raises:
        InputError: If the network does not fit the description.
    """

    class Options(BaseModel):
        """Options of ``onnx``."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        model: str = Field(description="ONNX file, or name of a known network.")
        description: str | None = Field(
            None,
            description="Description of inputs and outputs: a built-in name or a YAML file; guessed if not given.",
        )
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")

    def __init__(self, network: Network, description: EncoderDescription | None = None) -> None:
        self._network = network
        self._description = description or EncoderDescription()
        self._input = _input(network, self._description.input)
        batch, _, *sides = self._input.shape
        self._one_by_one = batch is not None
        self._sides: tuple[int | None, int | None] = (sides[0], sides[1])
        self.tau = self._description.tau
        multiple = self._description.input.multiple
        side = multiple * max(-(-_TRIAL_SIDE // multiple), 1)
        height, width = (fixed or side for fixed in self._sides)
        answers = self._answers(torch.zeros(1, 3, height, width))
        self._outputs = _outputs(network, self._description, answers)
        maps = [answers[name] for name in self._outputs]
        self.stride = self._description.stride or max(round(height / maps[0].shape[-2]), 1)
        self.channels = int(self._combine(maps, (1, 1)).shape[1])

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Load the network and its description.

        Raises:
            InputError: If there is no such network or description, or they do not fit.
        """
        given = cls.Options.model_validate(options.model_dump())
        description = None if given.description is None else load_encoder_description(given.description)
        return cls(Network(find_network(given.model), given.threads), description)

    def encode(self, images: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` RGB in [0, 1] as ``(B, C, H / stride, W / stride)``; sizes are rounded down.

        Raises:
            InputError: If the network cannot be run on images of this size.
        """
        batches = images.split(1) if self._one_by_one else [images]
        return torch.cat([self._encode(batch) for batch in batches]).to(images.device)

    def _encode(self, images: Tensor) -> Tensor:
        images = images.detach().cpu().float()
        fitted = self._fit_size(images)
        answers = self._answers(fitted)
        height, width = (max(side // self.stride, 1) for side in images.shape[-2:])
        if self._resizes:
            return self._combine([answers[name] for name in self._outputs], (height, width))
        whole = tuple(max(side // self.stride, 1) for side in fitted.shape[-2:])
        return self._combine([answers[name] for name in self._outputs], whole)[..., :height, :width]

    @property
    def _resizes(self) -> bool:
        return self._description.input.fit == "resize" or any(self._sides)

    def _fit_size(self, images: Tensor) -> Tensor:
        """The images at a size that the network takes."""
        multiple = self._description.input.multiple
        height, width = (
            fixed or -(-side // multiple) * multiple
            for side, fixed in zip(images.shape[-2:], self._sides, strict=True)
        )
        if (height, width) == images.shape[-2:]:
            return images
        if self._resizes:
            return functional.interpolate(images, size=(height, width), mode="bilinear", antialias=True)
        border = (0, width - images.shape[-1], 0, height - images.shape[-2])
        return functional.pad(images, border, mode="replicate")

    def _answers(self, images: Tensor) -> dict[str, Tensor]:
        """What the network says, by output."""
        how = self._description.input
        mean, std = (images.new_tensor(values)[:, None, None] for values in (how.mean, how.std))
        scaled = (how.scale * images - mean) / std
        if how.channels == "bgr":
            scaled = scaled.flip(1)
        array = scaled.numpy().astype(self._input.dtype)
        answers = self._network.run({self._input.name: array})
        return {name: torch.from_numpy(value) for name, value in answers.items() if value.dtype.kind == "f"}

    def _combine(self, maps: list[Tensor], size: tuple[int, ...]) -> Tensor:
        """The features ``(B, C, *size)`` of one or several maps."""
        how = self._description
        resized = [
            one.float()
            if one.shape[-2:] == size
            else functional.interpolate(one.float(), size=size, mode="bilinear", antialias=True)
            for one in maps
        ]
        if how.normalise == "each":
            resized = [functional.normalize(one, dim=1) for one in resized]
        together = torch.cat(resized, dim=1) if how.combine == "concatenate" else sum(resized[1:], resized[0])
        return together if how.normalise == "none" else functional.normalize(together, dim=1)


def _input(network: Network, how: NetworkInput) -> TensorInfo:
    """The network's input that takes the image."""
    names = list(network.inputs)
    if how.name is not None and how.name not in names:
        raise InputError(
            f"{network.file} has no input '{how.name}'; it has {', '.join(names)}; correct input.name."
        )
    if len(names) != 1:
        raise InputError(
            f"{network.file} has the inputs {', '.join(names)}, but a feature network takes only an image; "
            "export it with one input."
        )
    info = network.inputs[names[0]]
    if len(info.shape) != 4 or info.shape[1] not in (3, None) or not info.dtype.startswith("float"):
        shape = ", ".join("any" if size is None else str(size) for size in info.shape)
        raise InputError(
            f"The input '{info.name}' of {network.file} is ({shape}) of {info.dtype}, not (batch, 3, height, "
            "width) of floats; export it with such an input."
        )
    return info


def _outputs(
    network: Network, description: EncoderDescription, answers: dict[str, Tensor]
) -> tuple[str, ...]:
    """Names of the outputs that are feature maps."""
    maps = {name: value for name, value in answers.items() if value.ndim == 4}
    shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in answers.items())
    for name in description.outputs:
        if name not in maps:
            raise InputError(
                f"{network.file} has no feature map '{name}'; for an image of zeros it returns {shapes}: "
                "correct output."
            )
    if description.outputs:
        _check_sum(network, description, [maps[name] for name in description.outputs])
        return description.outputs
    most = max((value.shape[1] for value in maps.values()), default=0)
    best = [name for name, value in maps.items() if value.shape[1] == most]
    if len(best) != 1:
        raise InputError(
            f"{network.file} returns {shapes}; it is ambiguous which output is the feature map; {_HOW_TO}, "
            f"with a line such as 'output: {next(iter(answers), 'NAME')}'."
        )
    return (best[0],)


def _check_sum(network: Network, description: EncoderDescription, maps: list[Tensor]) -> None:
    counts = [value.shape[1] for value in maps]
    if description.combine == "sum" and len(set(counts)) > 1:
        raise InputError(
            f"The outputs of {network.file} have {', '.join(map(str, counts))} channels and cannot be added; "
            "write 'combine: concatenate'."
        )


PACKAGE = "tracking3d.features.onnx"
"""The package whose folder ``descriptions`` holds the built-in descriptions."""

Triple = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class NetworkInput(Section):
    """How an image becomes a network's input: RGB in [0, 1] scaled, the mean removed, divided by the deviation."""

    name: str | None = Field(None, description="Name of the input; the network's only input if not given.")
    scale: float = Field(1.0, gt=0, description="Factor for the image, applied first: 1 or 255.")
    mean: Triple = Field((0.0, 0.0, 0.0), description="Mean subtracted after that: red, green, blue.")
    std: tuple[Positive, Positive, Positive] = Field(
        (1.0, 1.0, 1.0), description="Standard deviation divided by after that: red, green, blue."
    )
    channels: Literal["rgb", "bgr"] = Field("rgb", description="Order of the channels.")
    multiple: int = Field(
        32,
        ge=1,
        le=1024,
        description="Height and width must be multiples of this, unless the network fixes them.",
    )
    fit: Literal["pad", "resize"] = Field(
        "pad",
        description="How sizes become multiples: by repeating the right and lower border, or by resizing.",
    )


class EncoderDescription(Section):
    """A dense feature network. Without any key it is what most are: RGB in [0, 1], one map, unit length."""

    title: str = Field("", description="Description for readers.")
    link: str = Field("", description="Origin, for readers.")
    input: NetworkInput = NetworkInput()
    output: str | tuple[str, ...] | None = Field(
        None,
        description="Name of the feature map, or of several; the one with the most channels if not given.",
    )
    combine: Literal["concatenate", "sum"] = Field(
        "concatenate", description="How several maps are combined after resizing to the size of the result."
    )
    stride: int | None = Field(
        None,
        ge=1,
        le=256,
        description="Image pixels per feature pixel; that of the (first) map if not given.",
    )
    normalise: Literal["unit", "each", "none"] = Field(
        "unit",
        description="Whether features are normalized to unit length: each of several maps and then all, or not at all.",
    )
    tau: float = Field(0.05, gt=0, description="Appearance loss below which a frame counts as explained.")

    @property
    def outputs(self) -> tuple[str, ...]:
        """The outputs that are named."""
        return (self.output,) if isinstance(self.output, str) else self.output or ()


def load_encoder_description(name: str | Path) -> EncoderDescription:
    """Read a description.

    Args:
        name: Name of a description that comes with the package, or a YAML file.

    Raises:
        InputError: If there is no such description, or a key or value in it cannot be used.
    """
    file, keys = read_description(name, PACKAGE, "description of a feature network")
    try:
        return EncoderDescription.model_validate(keys)
    except ValidationError as error:
        raise InputError(f"{file}: {describe_validation_error(error, EncoderDescription, 'key')}") from error
