"""A variant that is run on every sequence: a configuration and a source of initial masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, field_validator

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d_bench.benchmark.input_change import InputChange

DEGRADED, NOISE, HAND = "degraded:", "noise:", "hand"


class Variant(BaseModel):
    """One way to run every sequence."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    label: str  # what tables call it
    config: PipelineConfig  # the pipeline; what the masks need is set when they are known
    # tracker, truth, initial, degraded:IOU, noise:PIXELS, hand, or a folder that holds a folder of masks for every
    # sequence
    masks: str = "tracker"
    # environment variables of the process that runs it, such as which matrix kernels it uses
    environment: dict[str, str] = {}
    input: InputChange = InputChange()  # changes of the sequence's input

    @field_validator("masks")
    @classmethod
    def _is_a_source(cls, masks: str) -> str:
        if masks.startswith((DEGRADED, NOISE)):
            check_masks(masks)
        return masks

    @property
    def disturbance(self) -> tuple[Any, ...]:
        """What else a run depends on besides configuration and masks; empty if nothing."""
        changed = self.environment or self.input != InputChange()
        return (self.environment, self.input.model_dump()) if changed else ()

    def with_changes(self, label: str, *, masks: str | None = None, **settings: Any) -> Variant:
        """A variant with other masks and settings: ``solver__weights__motion=0`` sets that key."""
        document = self.config.model_dump()
        for path, value in settings.items():
            *sections, key = path.split("__")
            inner = document
            for section in sections:
                inner = inner[section]
            inner[key] = value
        config = PipelineConfig.model_validate(document)
        return self.model_copy(update={"label": label, "config": config, "masks": masks or self.masks})


def degraded_iou(masks: str) -> float:
    """The mean IoU in ``degraded:IOU``.

    Raises:
        InputError: If it is not a number between 0.2 and 1.
    """
    try:
        iou = float(masks.removeprefix(DEGRADED))
    except ValueError:
        iou = -1.0
    if not 0.2 <= iou <= 1:
        raise InputError(
            f"The masks '{masks}' name no mean IoU from 0.2 to 1; write for example degraded:0.73."
        )
    return iou


def noise_pixels(masks: str) -> float:
    """The standard deviation in ``noise:PIXELS``.

    Raises:
        InputError: If it is not a number between 0.1 and 50.
    """
    try:
        pixels = float(masks.removeprefix(NOISE))
    except ValueError:
        pixels = -1.0
    if not 0.1 <= pixels <= 50:
        raise InputError(f"The masks '{masks}' name no pixels from 0.1 to 50; write for example noise:1.5.")
    return pixels


def check_masks(masks: str) -> None:
    """Check that a source of masks exists.

    Raises:
        InputError: If it is none of the words, and no folder.
    """
    if masks.startswith(DEGRADED):
        degraded_iou(masks)
    elif masks.startswith(NOISE):
        noise_pixels(masks)
    elif masks not in ("tracker", "truth", "initial", HAND) and not Path(masks).is_dir():
        raise InputError(
            f"The masks '{masks}' are unknown; give tracker, truth, initial, degraded:IOU, noise:PIXELS, hand, "
            "or a folder that exists."
        )
