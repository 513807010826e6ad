"""Options of the mask tracker ``onnx``, and what is built from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from tracking3d.errors import InputError
from tracking3d.networks.store import find_network
from tracking3d.trackers.csrt import CsrtTracker
from tracking3d.trackers.onnx.boxes import BoxProposer, CsrtBoxes, nano_boxes, vit_boxes
from tracking3d.trackers.onnx.description import SaliencyNetwork, load_segmenter_description
from tracking3d.trackers.onnx.images import TRIAL_BOX, TRIAL_IMAGE
from tracking3d.trackers.onnx.promptable import PromptableSegmenter
from tracking3d.trackers.onnx.proposals import Segmenter
from tracking3d.trackers.onnx.saliency import SaliencySegmenter
from tracking3d.trackers.protocol import Options


class OnnxOptions(Options):
    """Options of ``onnx``."""

    segmenter: str = Field(
        "u2netp", description="Description of inputs and outputs: a built-in name, or a YAML file."
    )
    model: str | None = Field(None, description="Saliency network: ONNX file, or name of a known network.")
    encoder: str | None = Field(None, description="Image encoder: ONNX file or known name.")
    decoder: str | None = Field(None, description="Prompt decoder: ONNX file or known name.")
    box: Literal["csrt", "nano", "vit"] = Field(
        "csrt", description="Box tracker: CSR-DCF, or NanoTrack or VitTrack from ONNX files."
    )
    nano_backbone: str = Field(
        "nanotrack-backbone", description="NanoTrack's backbone: ONNX file, or name of a known network."
    )
    nano_head: str = Field(
        "nanotrack-head", description="NanoTrack's head: ONNX file, or name of a known network."
    )
    vit_model: str = Field(
        "vittrack", description="VitTrack's network: ONNX file, or name of a known network."
    )
    csrt: CsrtTracker.Options = Field(CsrtTracker.Options(), description="Options of CSR-DCF.")
    every: Annotated[int, Field(ge=1, le=1000)] | Literal["auto"] = Field(
        1,
        description="Run the network in every k-th frame, or (auto) if the propagated mask is in doubt, was corrected, "
        "or has moved or changed much; flow propagates the mask in between.",
    )
    crops: tuple[Annotated[float, Field(ge=1, le=4)], ...] = Field(
        (1.2, 1.5), min_length=1, description="Saliency network: factors by which the box is enlarged."
    )
    anchor: bool = Field(True, description="Re-initialize the box tracker on the box of a confident mask.")
    threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")


def build_segmenter(options: OnnxOptions) -> Segmenter:
    """The segmentation network that ``options`` ask for, once it was asked about an image.

    Raises:
        InputError: If a description or a file is missing or cannot be used, or if what it says is no mask.
    """
    description = load_segmenter_description(options.segmenter)

    def file(option: str, given: str | None, default: str | None) -> Path:
        return _file(option, given or default, f"the segmenter '{options.segmenter}'")

    segmenter: Segmenter
    if isinstance(description, SaliencyNetwork):
        model = file("model", options.model, description.model)
        segmenter = SaliencySegmenter(model, description, options.crops, options.threads)
    else:
        encoder = file("encoder", options.encoder, description.encoder_model)
        decoder = file("decoder", options.decoder, description.decoder_model)
        segmenter = PromptableSegmenter(encoder, decoder, description, options.threads)
    segmenter.propose(TRIAL_IMAGE, TRIAL_BOX, None)
    return segmenter


def build_boxes(options: OnnxOptions) -> BoxProposer:
    """The box tracker that ``options`` ask for.

    Raises:
        InputError: If a file is missing or cannot be used.
    """
    match options.box:
        case "nano":
            backbone = _file("nano_backbone", options.nano_backbone, "the box tracker NanoTrack")
            return nano_boxes(backbone, _file("nano_head", options.nano_head, "the box tracker NanoTrack"))
        case "vit":
            return vit_boxes(_file("vit_model", options.vit_model, "the box tracker VitTrack"))
        case _:
            return CsrtBoxes(options.csrt)


def _file(option: str, name: str | None, whose: str) -> Path:
    """The file of a network; errors name the option that gives it."""
    if name is None:
        raise InputError(f"No ONNX file is given for {whose}; set the option tracker.{option}.")
    try:
        return find_network(name)
    except InputError as error:
        raise InputError(f"For {whose} (option tracker.{option}): {error}") from error
