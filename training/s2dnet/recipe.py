"""What a training run is: every number in one checked file."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field


class Recipe(BaseModel):
    """See ``recipe.yaml`` for the values that made the shipped weights."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    photographs: list[Path] = Field(description="Folders of photographs.")
    cutouts: list[Path] = Field(
        description="Folders of pictures with transparent parts, pasted on photographs."
    )
    teacher: Path | None = Field(None, description="ONNX file of the teacher; None trains without one.")
    initial: Path | None = Field(
        None, description="Checkpoint whose network is trained on; None starts anew."
    )
    seed: int = 0
    threads: int = Field(1, ge=1, description="CPU threads of torch.")
    device: str = "cpu"
    size: int = Field(192, multiple_of=32, description="Side of a training image in pixels.")
    crops: int = Field(1200, description="Fixed clear crops; every use warps and lights them anew.")
    objects: int = Field(120, description="Rendered objects with five frames each.")
    points: int = Field(300, description="Points in a crop or an object.")
    steps: int = Field(5000, description="Steps of the optimizer.")
    warped_pairs: int = Field(3, description="Pairs by homography in a step.")
    rendered_pairs: int = Field(1, description="Pairs of rendered frames in a step.")
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    warm_up: int = Field(100, description="Steps until the learning rate is reached; a cosine takes it to 0.")
    temperature: float = Field(0.05, description="Of the softmax over candidates.")
    radius: float = Field(3.0, description="Candidates nearer to the truth, in pixels, are no mistakes.")
    candidate_step: int = Field(2, description="Every so many cells of a map are candidates, both ways.")
    distillation: float = Field(0.5, description="Weight of the teacher's opinion.")
    teacher_temperature: float = 0.07
    checkpoint_every: int = 250


def read_recipe(file: Path) -> Recipe:
    """The recipe in a YAML file; its folders are relative to the working directory."""
    return Recipe.model_validate(yaml.safe_load(file.read_text(encoding="utf-8")))
