"""One video of a batch: its path, prompt, settings, the name of its results, and the networks that it needs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from tracking3d.config.models import AUTO, PipelineConfig
from tracking3d.engines.protocol import Engine, Shared
from tracking3d.features.networks.catalogue import known_networks
from tracking3d.features.networks.store import find_known, network_path
from tracking3d.pipeline.tracker_selection import CANDIDATES
from tracking3d.results.files import write_atomic, writing
from tracking3d.trackers.prompts.boxes import BoxFormat


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
    # length of the parts that it is cut into, see `tracking3d.pipeline.submaps.cuts.parse_length`; empty for none
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


@dataclass(frozen=True)
class SharedNetwork:
    """A network of the catalogue that a machine may lack."""

    name: str  # its name there
    content: Shared  # its file


def share_networks(engine: Engine, jobs: Iterable[VideoJob]) -> tuple[SharedNetwork, ...]:
    """Share the networks that the jobs name through the engine, if its workers may be on other machines.

    The mask tracker ``auto`` names all that it may choose from, so that it chooses there as it would here.
    Networks that are given by the path of a file are not sent: every machine must have them there.
    """
    known, jobs = known_networks(), list(jobs)
    named = {
        value
        for job in jobs
        for plugin in (job.config.tracker, job.config.features, job.config.keypoints)
        for value in plugin.model_dump().values()
        if isinstance(value, str) and value in known
    }
    if any(job.config.tracker.name == AUTO for job in jobs):
        named |= {network for candidate in CANDIDATES for network in candidate.networks}
    shared = []
    for name in sorted(named):
        path = network_path(known[name])
        if path.is_file() and (content := engine.share(path)) is not None:
            shared.append(SharedNetwork(name, content))
    return tuple(shared)


def keep_networks(networks: Iterable[SharedNetwork]) -> None:
    """Put the networks that this machine lacks into its cache, in which the plug-ins look for them.

    Raises:
        OutputError: If the cache cannot be written.
    """
    for network in networks:
        path = network_path(find_known(network.name))
        if not path.is_file():
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, network.content.read())
