"""A long video of a batch is a chain of tasks: parts side by side, one run at the end, one line in the tables."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from tracking3d.batch import tasks
from tracking3d.batch.folder import read_failures, read_result_rows
from tracking3d.batch.listing import list_jobs
from tracking3d.batch.running import run_batch
from tracking3d.batch.tasks import Tasks
from tracking3d.batch.video_job import VideoJob
from tracking3d.config.loading import load_config
from tracking3d.engines.choosing import InThisProcess
from tracking3d.engines.protocol import Ended as TaskEnded
from tracking3d.engines.protocol import Fault
from tracking3d.errors import OutputError
from tracking3d.pipeline.submaps.job import SplitResult
from tracking3d.pipeline.submaps.split_run import Step


@dataclass(frozen=True)
class Cut:
    """Stands for `PlannedVideo`."""

    folder: Path
    count: int = 4


@pytest.fixture
def cut(monkeypatch, finished_run):
    """A video is cut in two; what its steps did, what they are to raise, and why parts are not joined, if so."""
    done, faults, refused = [], {}, []

    def begin(tell, video):
        done.append(("begin", video.length, Path(video.source).stem))
        return Cut(video.folder)

    def part(tell, number):
        tell(None)
        done.append(number)
        if faults.get(number):
            raise faults[number].pop()
        return 10 * number

    def end(tell, folders):
        for folder in folders:
            shutil.copytree(finished_run, folder)

    def steps_of(planned):
        answers = yield [Step(part, number, f"part {number} of 2", 2) for number in (1, 2)]
        assert answers == [10, 20]
        folders = [planned.folder / "parts" / f"part_{n}" for n in (0, 1)] if refused else [planned.folder]
        yield [Step(end, folders, "its end")]
        return SplitResult(tuple(folders), 2, *refused)

    monkeypatch.setattr(tasks, "plan_video", begin)
    monkeypatch.setattr(tasks, "steps_of", steps_of)
    return done, faults, refused


@pytest.fixture
def long_batch(recorded, videos, tmp_path):
    def run(**more):
        told = []
        jobs = list_jobs(str(videos), lambda row: load_config(), "60")
        jobs = [job if job.name == "one" else replace(job, split="") for job in jobs]
        progress = run_batch(
            jobs,
            str(tmp_path / "out"),
            InThisProcess(),
            report=False,
            pause=0.0,
            listener=told.append,
            **more,
        )
        return progress, told

    return run


def test_its_parts_are_tasks_and_its_run_is_one_row(cut, long_batch, tmp_path):
    progress, told = long_batch()
    assert (progress.finished, progress.failed, progress.total) == (2, 0, 2)
    assert cut[0] == [("begin", "60", "one"), 1, 2]
    began = [one.about.get("step", "") for one in told if one.video == "one" and one.event == "began"]
    assert began == ["", "part 1 of 2", "part 2 of 2", "its end", "its report"]
    assert [one.event for one in told if one.video == "one"].count("finished") == 1
    assert sorted(row["run"] for row in read_result_rows(str(tmp_path / "out"))) == ["in/two", "one"]
    assert (tmp_path / "out/one/batch.json").is_file() and not (tmp_path / "out/.work").exists()


def test_parts_that_cannot_be_joined_are_a_row_each_with_the_reason(cut, long_batch, tmp_path):
    cut[2].append("they tell of two objects")
    progress, _ = long_batch()
    assert progress.failed == 0
    rows = {row["run"]: row for row in read_result_rows(str(tmp_path / "out"))}
    assert set(rows) == {"in/two", "one/parts/part_0", "one/parts/part_1"}
    assert "two objects" in rows["one/parts/part_1"]["note"] and not rows["in/two"]["note"]
    assert (tmp_path / "out/one/parts/part_1/run.json").is_file()
    assert "two objects" in (tmp_path / "out/index.html").read_text()


def test_a_part_that_fails_once_is_tried_again_by_itself(cut, long_batch, tmp_path):
    cut[1][2] = [OutputError("The disk is full.")]
    progress, _ = long_batch()
    assert progress.failed == 0 and cut[0].count(1) == 1 and cut[0].count(2) == 2
    [row] = [row for row in read_result_rows(str(tmp_path / "out")) if row["run"] == "one"]
    assert row["attempts"] == "2"


def test_a_part_that_always_fails_costs_its_video_only(cut, long_batch, tmp_path):
    cut[1][1] = [OutputError("The disk is full.") for _ in range(2)]
    cut[1][2] = [OutputError("The disk is full.") for _ in range(2)]
    progress, told = long_batch()
    assert (progress.finished, progress.failed) == (1, 1)
    assert [one.event for one in told if one.video == "one"].count("failed") == 1
    assert [failure.run for failure in read_failures(str(tmp_path / "out"))] == ["one"]
    again, _ = long_batch()
    assert again.finished == 2


def test_what_has_several_objects_or_is_corrected_is_tracked_whole():
    job = VideoJob("one", "one.mp4", load_config(), box=("1,1,9,9",), split="60")
    assert job.in_parts and job.key != replace(job, split="").key
    assert not replace(job, box=("1,1,9,9", "2,2,9,9")).in_parts
    assert not replace(job, correct=("2:1,1,9,9",)).in_parts and not replace(job, start_frame=2).in_parts


def test_nothing_follows_a_step_whose_video_has_failed(cut, tmp_path):
    job = VideoJob("one", "one.mp4", load_config(), box=("1,1,9,9",), split="60")
    chain = Tasks([job], str(tmp_path), "", False, 1, ())
    chain.first(0)
    first, second = chain.further(TaskEnded(0, Cut(tmp_path)))
    assert [chain.video(one.number) for one in (first, second)] == [0, 0]
    assert chain.further(TaskEnded(first.number, None, Fault("no"))) == []
    assert chain.further(TaskEnded(second.number, 20)) == []
