"""Poses and masks of the end, found for parts of a video in any process, are those that one process finds."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest

from tracking3d import load_config
from tracking3d.config.models import PipelineConfig
from tracking3d.pipeline.record import record
from tracking3d.pipeline.submaps.job import LongVideo
from tracking3d.pipeline.submaps.merge_step import MergedSubmaps
from tracking3d.pipeline.submaps.plan import Plan, PlannedVideo
from tracking3d.pipeline.submaps.split_run import Step, steps_to_the_end
from tracking3d.pipeline.submaps.submap_runs import Revisit
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.files import write_image, write_mask
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, degrade_masks, synthesize
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source

FRAMES = 18
TIMES = {"seconds", "stages"}


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> Path:
    """A clip, and its masks, about right, in a folder beside it."""
    clip = synthesize(SyntheticSpec(frames=FRAMES, degrees_per_frame=4, size=(160, 120)))
    folder = tmp_path_factory.mktemp("clip")
    for name in ("frames", "masks"):
        (folder / name).mkdir()
    for index, (image, mask) in enumerate(zip(clip.images, degrade_masks(clip.masks, 0, 3.0), strict=True)):
        write_image(folder / "frames" / f"{index:03d}.png", image)
        write_mask(folder / "masks" / f"{index:03d}.png", mask)
    return folder / "frames"


def settings(frames: Path, *overrides: str) -> PipelineConfig:
    return load_config(
        tracker={"name": "precomputed", "path": str(frames.parent / "masks")},
        overrides=["crop.size=64", "object.frequency=3", "object.texture_size=64", *overrides],
        camera={"fov": 45},
    )


def looked_at_again(frames: Path, config: PipelineConfig, folder: Path) -> Path:
    """A run that was stopped when all of its frames had their second answer."""
    save = Checkpoint.save

    def stopped(self, progress, *given):
        save(self, progress, *given)
        if progress.last_refined == FRAMES - 1:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Checkpoint, "save", stopped)
        with pytest.raises(KeyboardInterrupt):
            record(open_source(str(frames)), config, folder)
    return folder


def ended_in_parts(frames: Path, config: PipelineConfig, folder: Path, cut: int) -> list[list[Step]]:
    """Go on with such a run in two parts; the steps that were taken, side by side."""
    video = LongVideo(str(frames), config, folder, PromptSet(), "9f")
    planned = PlannedVideo(video, config, None, FRAMES, Plan([]), ())
    revisits = tuple(
        Revisit(str(frames), None, selection, config, folder, PromptSet(), folder / "not needed any more")
        for selection in (f"0:{cut}:1", f"{cut}:{FRAMES}:1")
    )
    return taken(
        steps_to_the_end(MergedSubmaps(planned, revisits, {}, {"refine": 1.0, "refinement_pass": 1.0}))
    )


def taken(steps: Generator[list[Step], list[Any], Any]) -> list[list[Step]]:
    """Take them, each as if in a process of its own."""
    done, estimates = [], None
    while True:
        try:
            wanted = next(steps) if estimates is None else steps.send(estimates)
        except StopIteration:
            return done
        done.append(wanted)
        estimates = [_in_a_process(step.function, step.argument) for step in wanted]


def _in_a_process(function: Callable[[Any, Any], Any], argument: Any) -> Any:
    """What goes there and comes back is pickled on its way."""
    return pickle.loads(pickle.dumps(function(lambda told: None, pickle.loads(pickle.dumps(argument)))))


def answers_of(folder: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (folder / layout.FRAMES).read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in TIMES} for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize("weighs", [True, False])
def test_parts_come_to_what_one_process_comes_to(weighs, frames, tmp_path):
    config = settings(frames, f"object.refine_masks={str(weighs).lower()}", "runtime.probabilities=true")
    whole = looked_at_again(frames, config, tmp_path / "whole")
    before = {path.name: path.read_bytes() for path in (whole / layout.REFINING / layout.MASKS).iterdir()}
    parts = Path(shutil.copytree(whole, tmp_path / "parts"))
    record(open_source(str(frames)), config, whole, resume=True)
    steps = ended_in_parts(frames, config, parts, cut=8)

    assert [len(side_by_side) for side_by_side in steps] == ([1, 2, 1, 2, 1] if weighs else [1, 2, 1])
    assert RunReader(parts).state == RunReader(whole).state == "finished"
    assert answers_of(parts) == answers_of(whole)
    changed = 0
    for kind in (layout.MASKS, layout.PROBABILITIES):
        found = sorted((whole / kind).iterdir())
        assert len(found) == FRAMES
        for path in found:
            assert (parts / kind / path.name).read_bytes() == path.read_bytes()
            changed += path.read_bytes() != before.get(path.name) and kind == layout.MASKS
    assert (changed > 0) == weighs  # there is something to be compared
    for name in layout.MESH_FILES:
        assert (parts / name).read_bytes() == (whole / name).read_bytes()
