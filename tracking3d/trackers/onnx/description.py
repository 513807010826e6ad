"""The inputs and outputs of a segmentation network: a short YAML description that users can write.

Two kinds are known. A *saliency* network finds the object that stands out in a crop (U2-Net, IS-Net). A
*promptable* one is an encoder, run once on an image, and a decoder that takes a box, points and a mask
(Segment Anything and its smaller relatives).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from tracking3d.config.explain import describe_validation_error
from tracking3d.config.models import Section
from tracking3d.errors import InputError
from tracking3d.features.networks.catalogue import read_description

PACKAGE = "tracking3d.trackers.onnx"
"""The package whose folder ``descriptions`` holds the built-in descriptions."""

Side = Annotated[int, Field(ge=16, le=4096)]
Triple = tuple[float, float, float]


class ImageInput(Section):
    """How an image becomes a network's input: resized, its grey values divided, mean and deviation removed."""

    name: str | None = Field(None, description="Name of the input; the network's first input if not given.")
    size: Side | tuple[Side, Side] | None = Field(
        None, description="Side, or height and width, in pixels; the image's own size if not given."
    )
    fit: Literal["stretch", "pad"] = Field(
        "stretch",
        description="Stretch to the size, or keep the proportions and pad at the right and below.",
    )
    padding: Triple = Field((0.0, 0.0, 0.0), description="Red, green, blue of the padding, 0 to 255.")
    divisor: Annotated[float, Field(gt=0)] | Literal["max"] = Field(
        255.0, description="Divisor of pixel values; max is the largest value of the image."
    )
    mean: Triple = Field((0.0, 0.0, 0.0), description="Mean subtracted after the division: red, green, blue.")
    std: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (1.0, 1.0, 1.0), min_length=3, max_length=3, description="Divisor after that: red, green, blue."
    )
    channels: Literal["rgb", "bgr"] = Field("rgb", description="Order of the channels.")
    layout: Literal["nchw", "nhwc", "chw", "hwc"] = Field(
        "nchw", description="Order of the axes: n is the batch of one image, c the channels."
    )


class SaliencyNetwork(Section):
    """A network that finds what stands out in an image, without a prompt."""

    kind: Literal["saliency"]
    title: str = Field("", description="Description for readers.")
    link: str = Field("", description="Origin, for readers.")
    model: str | None = Field(
        None, description="ONNX file, or name of a known network, used if the option model is not given."
    )
    input: ImageInput = ImageInput()
    output: str | None = Field(
        None, description="Name of the output; the network's first output if not given."
    )
    channel: int = Field(0, ge=0, description="Channel of the output that is the object.")
    activation: Literal["none", "sigmoid", "softmax"] = Field(
        "none", description="Activation of the output: sigmoid for logits, softmax over channels."
    )
    normalise: bool = Field(
        False, description="Rescale the result so that its minimum is 0 and its maximum 1."
    )


class Decoder(Section):
    """Names of a prompt decoder's inputs and outputs, and the pixels it counts in."""

    points: str = Field("point_coords", description="Input: points (x, y), and a box's two corners.")
    labels: str = Field(
        "point_labels", description="Input: 1 object, 0 background, 2 and 3 a box's corners, -1 padding."
    )
    mask: str | None = Field("mask_input", description="Input: the previous mask as logits; null if none.")
    has_mask: str | None = Field("has_mask_input", description="Input: 1 if that mask is used; or null.")
    frame_size: str | None = Field(
        "orig_im_size", description="Input: height and width of the image before the encoder; null if none."
    )
    coordinates: Literal["input", "image", "unit"] = Field(
        "input",
        description="Coordinates: pixels of the encoder's input or of the image, or fractions of its sides.",
    )
    masks: str | None = Field(None, description="Output with the mask or masks; the first if not given.")
    grid: Literal["image", "input"] = Field(
        "image", description="What the masks cover: the image, or the encoder's input with its padding."
    )
    logits: bool = Field(True, description="Masks are logits; false for probabilities in [0, 1].")
    padding_point: bool = Field(False, description="Add a padding point, label -1, to prompts without a box.")


class PromptableNetwork(Section):
    """A network of two files: an image encoder, and a decoder of prompts."""

    kind: Literal["promptable"]
    title: str = Field("", description="Description for readers.")
    link: str = Field("", description="Origin, for readers.")
    encoder_model: str | None = Field(
        None,
        description="ONNX file or known name of the encoder, used if the option encoder is not given.",
    )
    decoder_model: str | None = Field(None, description="The same for the decoder.")
    input: ImageInput = ImageInput(size=1024, fit="pad", divisor=1.0)
    embeddings: dict[str, str] = Field(
        {},
        description="Decoder input: encoder output, if their names differ; equal names need no entry.",
    )
    decoder: Decoder = Decoder()


Description = SaliencyNetwork | PromptableNetwork


def load_segmenter_description(segmenter: str | Path) -> Description:
    """Read a description.

    Args:
        segmenter: Name of one that comes with the package, or a YAML file.

    Raises:
        InputError: If there is no such description, or a key or value in it cannot be used.
    """
    file, data = read_description(segmenter, PACKAGE, "segmenter")
    models: dict[str, type[Description]] = {"saliency": SaliencyNetwork, "promptable": PromptableNetwork}
    model = models.get(str(data.get("kind")))
    if model is None:
        raise InputError(f"{file}: the key 'kind' must be one of {' and '.join(models)}; write it first.")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{file}: {describe_validation_error(error, model, 'key')}") from error
