"""What a training run is: every number in one checked file."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field


class Recipe(BaseModel):
    """See ``recipe.yaml`` for the values that made the weights."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    photos: Path = Field(description="Folder that collect.py filled.")
    masks: Path = Field(description="Folder that make_masks.py filled.")
    hands: Path | None = Field(None, description="Folder with cut-outs of real hands, RGBA PNG.")
    hand_masks: Path | None = Field(
        None, description="Folder with the masks of hands that make_hands.py filled."
    )
    pool: Path = Field(description="Folder of the prepared samples.")
    seed: int = 0
    threads: int = Field(1, ge=1, description="CPU threads of torch.")
    device: str = "cpu"
    shard: int = Field(400, description="Samples in a file of the pool.")
    shards: int = Field(100, description="Files of the pool.")
    stills: float = Field(
        0.45, ge=0, le=1, description="Share of photographs with the teacher's masks in the pool."
    )
    first: Path | None = Field(None, description="Exported network whose weights the training begins with.")
    batch: int = 16
    replay: bool = Field(False, description="Whether the step is recorded and replayed, on a GPU.")
    workers: int = Field(1, ge=0, description="Processes that make batches.")
    steps: int = Field(30000, description="Steps of the optimizer.")
    seconds: float | None = Field(
        None, gt=0, description="The training ends after so many seconds if it is not done before."
    )
    sizes: dict[int, int] = Field({0: 128, 20000: 160}, description="Step -> side of the crops from then on.")
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    warm_up: int = 200
    cool_down: float = Field(0.35, description="Share of the steps at the end in which the rate falls to 0.")
    average: float = Field(0.998, description="Decay of the running average of the weights that is exported.")
    box_only: float = Field(0.45, description="Share of samples with the box in place of the carried mask.")
    keep_colours: float = Field(
        0.75, description="Share of the others that have colours; of boxes a tenth of it."
    )
    keep_motion: float = Field(0.6, description="Share of the others that have motion.")
    overlap_loss: float = Field(0.5, description="Weight of the loss by intersection over union.")
    occluder_loss: float = Field(0.5, description="Weight of the occluder's map.")
    checkpoint_every: int = 250
    validate_every: int = 1000


def read_recipe(file: Path) -> Recipe:
    """The recipe in a YAML file; its folders are relative to the working directory."""
    return Recipe.model_validate(yaml.safe_load(file.read_text(encoding="utf-8")))
