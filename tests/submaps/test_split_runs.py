"""A video tracked in parts is one ordinary run, as good as a whole one; where it cannot be, it is a run a part."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tracking3d import load_config
from tracking3d.errors import InputError, OutputError
from tracking3d.pipeline.record import record
from tracking3d.pipeline.submaps import merge_step, plan, split_run
from tracking3d.pipeline.submaps.alignment import DisagreementError
from tracking3d.pipeline.submaps.job import SplitResult
from tracking3d.pipeline.submaps.plan import PARTS
from tracking3d.pipeline.submaps.split_run import record_in_parts
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.files import write_image, write_mask
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, degrade_masks, synthesize
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

LONG = 60


def written(clip: SyntheticClip, folder: Path) -> Path:
    """The clip's frames, and beside them its masks, about right."""
    (folder / "frames").mkdir(parents=True)
    (folder / "masks").mkdir()
    for index, (image, mask) in enumerate(zip(clip.images, degrade_masks(clip.masks, 0), strict=True)):
        write_image(folder / "frames" / f"{index:03d}.png", image)
        write_mask(folder / "masks" / f"{index:03d}.png", mask)
    return folder / "frames"


def settings(frames: Path, *overrides: str):
    return load_config(
        tracker={"name": "precomputed", "path": str(frames.parent / "masks")},
        overrides=["crop.size=64", "object.frequency=3", "object.texture_size=64", *overrides],
        camera={"fov": 45},
    )


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> Path:
    """A clip that nothing is tracked in: what is asked of it is refused, or goes to a stand-in."""
    clip = synthesize(SyntheticSpec(frames=50, size=(48, 40), supersample=1))
    return written(clip, tmp_path_factory.mktemp("short"))


@pytest.mark.parametrize("length", ["0", "-5f", "3f", "many", "nan"])
def test_a_wrong_length_is_refused_before_anything_is_written(length, short, tmp_path):
    with pytest.raises(InputError, match="split="):
        record_in_parts(short, settings(short), tmp_path / "run", PromptSet(), length=length)
    assert not (tmp_path / "run").exists()


def test_seconds_are_refused_of_images_without_a_rate(short, tmp_path):
    with pytest.raises(InputError, match="in frames"):
        record_in_parts(short, settings(short), tmp_path / "run", PromptSet(), length="5")


@pytest.mark.parametrize("override", ["solver.final_refine=false", "solver.name=paper"])
def test_what_cannot_be_joined_is_not_split(override, short, tmp_path):
    with pytest.raises(InputError, match="final refinement"):
        record_in_parts(short, settings(short, override), tmp_path / "run", PromptSet(), length="25f")


def test_a_video_shorter_than_a_part_is_one_run(short, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(plan, "record_tracking", lambda request, folder, options, tell: asked.append(options))
    ended = record_in_parts(
        short, settings(short), tmp_path / "run", PromptSet(), length="1000f", selection="0:40"
    )
    assert (ended.folders, ended.parts) == ((tmp_path / "run",), 1)
    assert "one part" in ended.reason
    assert [options.selection for options in asked] == ["0:40"]


def test_parts_that_cannot_be_joined_are_finished_each_by_itself(short, tmp_path, monkeypatch):
    """And said to be so a second time, without tracking them again."""
    done: list[tuple[str, bool, str]] = []

    def track(tell, job):
        done.append((job.folder.name, job.first_pass_only, job.selection))
        if not job.first_pass_only:
            monkeypatch.setattr(plan, "is_finished", lambda folder: True)

    def refuse(*given):
        raise DisagreementError("parts 1 and 2: they tell of two objects")

    monkeypatch.setattr(split_run, "track_part", track)
    monkeypatch.setattr(merge_step, "merge_submaps", refuse)
    monkeypatch.setattr(merge_step, "_find_running", lambda tracked: None)
    run = tmp_path / "run"
    ended = record_in_parts(
        short, settings(short), run, PromptSet(), length="25f", workers=1, selection="2:50"
    )
    assert ended == SplitResult((run / PARTS / "part_0", run / PARTS / "part_1"), 2, ended.reason)
    assert "two objects" in ended.reason
    assert [(name, first) for name, first, _ in done] == [
        ("part_0", True), ("part_1", True), ("part_0", False), ("part_1", False),
    ]  # fmt: skip
    (first, stop), (start, last) = ((int(n) for n in one[2].split(":")[:2]) for one in done[:2])
    assert (first, last) == (2, 50)
    assert first < start < stop < last
    again = record_in_parts(
        short, settings(short), run, PromptSet(), length="25f", workers=1, selection="2:50", resume=True
    )
    assert again.folders == ended.folders
    assert len(done) == 4


def test_parts_of_other_settings_are_not_gone_on_with(short, tmp_path, monkeypatch):
    def fail(tell, job):
        raise OutputError("The disk is full.")

    monkeypatch.setattr(split_run, "track_part", fail)
    run = tmp_path / "run"
    with pytest.raises(OutputError):
        record_in_parts(short, settings(short), run, PromptSet(), length="25f", workers=1)
    with pytest.raises(InputError, match="length of parts"):
        record_in_parts(short, settings(short), run, PromptSet(), length="24f", workers=1, resume=True)
    with pytest.raises(InputError, match="configuration"):
        record_in_parts(
            short, settings(short, "crop.size=32"), run, PromptSet(), length="25f", workers=1, resume=True
        )
    (run / PARTS / "plan.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        record_in_parts(short, settings(short), run, PromptSet(), length="25f", workers=1, resume=True)


def test_a_folder_of_somebody_s_parts_is_left_alone(short, tmp_path, monkeypatch):
    own = tmp_path / "run" / PARTS / "mine.txt"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    monkeypatch.setattr(plan, "record_tracking", lambda *given: None)
    record_in_parts(short, settings(short), tmp_path / "run", PromptSet(), length="1000f", overwrite=True)
    assert own.read_text() == "mine"


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=LONG, degrees_per_frame=4, size=(200, 160)))


def files_of(folder: Path) -> set[Path]:
    """What a run is read from; rollback points for corrections are of the run that made them."""
    found = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    return {path for path in found if path.parts[0] != layout.STATE}


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_video_in_two_parts_is_one_run_as_good_as_a_whole_one(workers, clip, tmp_path):
    frames = written(clip, tmp_path / "clip")
    config = settings(frames, "runtime.probabilities=true")
    told: list[tuple[int, bool]] = []
    ended = record_in_parts(
        frames, config, tmp_path / "split", PromptSet(), length="30f", workers=workers,
        listener=lambda one: told.append((one.index, one.refined)),
    )  # fmt: skip
    assert ended == SplitResult((tmp_path / "split",), 2)
    assert sorted(told) == sorted([(index, refined) for index in range(LONG) for refined in (False, True)])
    record(open_source(str(frames)), config, tmp_path / "whole")

    errors = {}
    for name in ("split", "whole"):
        run = RunReader(tmp_path / name)
        assert run.state == "finished"
        assert [one.index for one in run.frames] == list(range(LONG))
        assert all(run.mask(one.index).any() for one in run.frames)
        assert run.mesh().vertices.size
        R = np.stack([one.T_cam_obj[:3, :3] for one in run.frames])
        errors[name] = aligned_rotation_errors(R, clip.T_cam_obj[:, :3, :3])
    assert errors["split"].mean() < errors["whole"].mean() + 0.5
    assert errors["split"].max() < max(errors["whole"].max(), 6)
    causal = RunReader(tmp_path / "split", refined=False)
    R = np.stack([one.T_cam_obj[:3, :3] for one in causal.frames])
    assert aligned_rotation_errors(R, clip.T_cam_obj[:, :3, :3]).mean() < 4
    split, whole = (RunReader(tmp_path / name).description for name in ("split", "whole"))
    assert split["counts"]["frames"] == whole["counts"]["frames"]
    assert split["prompt"] == whole["prompt"]
    assert split["refinement"]["frames"] == LONG
    assert split["split"]["alignments"][0]["frames"] >= 5
    assert files_of(tmp_path / "split") == files_of(tmp_path / "whole")
    assert len(load_model(tmp_path / "split").vertices) == len(load_model(tmp_path / "whole").vertices)
    record_in_parts(
        frames, config, tmp_path / "split", PromptSet(), length="30f", resume=True
    )  # done already


@pytest.mark.slow
def test_a_split_run_that_was_stopped_anywhere_goes_on(clip, tmp_path, monkeypatch):
    frames, run = written(clip, tmp_path / "clip"), tmp_path / "run"

    def go_on() -> SplitResult:
        return record_in_parts(
            frames, settings(frames), run, PromptSet(), length="30f", workers=1, resume=True
        )

    saves, save = [0], Checkpoint.save
    due = {"in the first part", "in the second", "joined", "looked at again"}

    def stopped_now_and_then(self, progress, *given):
        saves[0] += 1
        moments = {
            "in the first part": saves[0] >= 3,
            "in the second": saves[0] >= 12,
            "joined": progress.refining,
            "looked at again": progress.last_refined >= 0,
        }
        for moment in sorted(due):
            if moments[moment]:
                due.remove(moment)
                raise KeyboardInterrupt
        save(self, progress, *given)

    monkeypatch.setattr(Checkpoint, "save", stopped_now_and_then)
    stops = 0
    while True:
        try:
            ended = go_on()
            break
        except KeyboardInterrupt:
            stops += 1
    assert (stops, due) == (4, set())
    assert ended == SplitResult((run,), ended.parts)
    assert RunReader(run).state == "finished"
    assert json.loads((run / layout.RUN).read_bytes())["split"]["parts"]
    R = np.stack([one.T_cam_obj[:3, :3] for one in RunReader(run).frames])
    assert len(R) == LONG
    assert aligned_rotation_errors(R, clip.T_cam_obj[:, :3, :3]).mean() < 3
