"""One video of a batch: its path, prompt, settings, and the name of its results."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from tracking3d.config.models import PipelineConfig
from tracking3d.prompts.boxes import BoxFormat


@dataclass(frozen=True)
class VideoJob:
    """What one worker does in one go: a video is decoded once, however many objects are tracked in it."""

    name: str  # its run folder within that of the batch
    video: str  # video file, folder or pattern of images
    config: PipelineConfig  # the pipeline
    box: tuple[str, ...] = ()  # objects by their box in the first frame, as tracking3d run --box has them
    mask: tuple[str, ...] = ()  # objects by the image file of their mask
    points: tuple[str, ...] = ()  # objects by points
    correct: tuple[str, ...] = ()  # corrections
    start_frame: int | None = None  # the frame in which the objects are given; None for the first
    frames: str | None = None  # START:STOP:STEP
    # layout, folder and name of a sequence of a dataset, whose images are then the video
    sequence: tuple[str, str, str] | None = None
    size: int = 0  # bytes of the video, if known: large ones are begun first
    fault: str = ""  # why it cannot be done, if known beforehand
    # length of the parts that it is cut into, see `tracking3d.submaps.cuts.parse_length`; empty for none
    split: str = ""
    box_format: BoxFormat = "xywh"  # how boxes are written, in corrections too

    @property
    def in_parts(self) -> bool:
        """Whether it may be cut: only parts of one object that is prompted in the first frame can be merged."""
        whole = self.sequence is not None or self.start_frame is not None or self.correct or self.objects > 1
        return bool(self.split) and not whole

    @property
    def objects(self) -> int:
        """How many objects are tracked."""
        return max(len(self.box) + len(self.mask) + len(self.points), 1)

    @cached_property
    def key(self) -> str:
        """A key of its video, prompt and settings."""
        identity: dict[str, Any] = {
            "video": self.video,
            "config": self.config.model_dump(mode="json"),
            "objects": [self.box, self.mask, self.points],
            "correct": self.correct,
            "start_frame": self.start_frame,
            "frames": self.frames,
            "sequence": self.sequence,
        }
        if self.split:
            identity["split"] = self.split
        if self.box_format != "xywh":
            identity["box_format"] = self.box_format
        return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
