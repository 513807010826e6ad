"""Batches with real workers and real tracking: slow. Answers are those of single runs; faults cost their video only."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from heavy_task import hold

from batch_passes import ABORTING, DAMAGED, FILLING, Asked, demonstrate, make_clips
from machine_load import load_now
from tracking3d.batch.running import run_batch
from tracking3d.batch.video_job import VideoJob
from tracking3d.config.loading import load_config
from tracking3d.engines.choosing import open_engine
from tracking3d.engines.mapping import map_tasks
from tracking3d.engines.processes import ProcessEngine
from tracking3d.engines.protocol import Ended, Task
from tracking3d.results.files import write_image, write_mask
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize, write_clip
from tracking3d_bench.benchmark.job import Job
from tracking3d_bench.benchmark.pool import run_jobs
from tracking3d_bench.benchmark.variant import Variant
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

pytestmark = [
    pytest.mark.slow,
    # Files and sockets that Ray leaves to the end of its processes.
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning"),
]

QUICK = ["crop.size=32", "object.frequency=2", "camera.fov=45", "solver.final_refine=false"]


@pytest.fixture
def config():
    return load_config(overrides=QUICK)


@pytest.fixture
def workers_find_the_package(monkeypatch):
    """Workers of Ray run the code that is tested."""
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))


def poses(folder: Path) -> np.ndarray:
    return np.stack([record.T_cam_obj for record in RunReader(folder).frames])


def test_whatever_goes_wrong_all_other_answers_are_those_of_a_single_run(config, tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKING3D_PLUGINS", "")  # is put back at the end
    asked = Asked(videos=3, frames=5, size=(200, 160), workers=(2,), faults=3, report=False)
    said = []
    plain, faults, single = demonstrate(config, tmp_path, asked, said.append)
    assert plain.failed == {} and plain.finished == 3
    assert set(faults.failed) == {DAMAGED, ABORTING} and faults.finished == 4
    assert {"clip_0001", FILLING, DAMAGED, ABORTING} <= set(faults.again)
    assert "signal 6" in faults.failed[ABORTING]
    assert faults.different < 1e-9 and single.different < 1e-9
    assert single.finished == 3 and any("3 of 3 videos" in line for line in said)


@pytest.mark.parametrize("address", [None, "local"])
def test_sigterm_keeps_what_is_done_and_the_same_batch_goes_on(
    config, tmp_path, address, workers_find_the_package
):
    if address:
        pytest.importorskip("ray", reason="the extra ray is not installed")
    jobs = make_clips(tmp_path / "clips", 2, 30, config)
    out = tmp_path / "out"

    def stop(happening):
        if happening.event == "progress" and happening.about.get("frames", 0) >= 1:
            os.kill(os.getpid(), signal.SIGINT)

    with open_engine(address, 1) as engine:
        with pytest.raises(KeyboardInterrupt):
            run_batch(jobs, str(out), engine, report=False, listener=stop)
        [work] = (out / ".work").iterdir()
        state = json.loads((work / "run/run.json").read_text())["state"]
        assert state == "interrupted" and not list(out.glob("clip_*"))
        progress = run_batch(jobs, str(out), engine, report=False)
    assert progress.finished == 2
    resumed = [json.loads((out / job.name / "run.json").read_text())["resumed"] for job in jobs]
    assert sorted(map(len, resumed)) == [0, 1]


def test_evaluate_gives_the_same_figures_on_both_engines(tmp_path, workers_find_the_package):
    pytest.importorskip("ray", reason="the extra ray is not installed")
    clip = synthesize(SyntheticSpec(frames=4, size=(64, 48), supersample=1))
    for name in ("one", "two"):
        poses, camera = clip.T_cam_obj, clip.camera
        write_clip(tmp_path / "clips" / name, clip.images, clip.masks, poses, camera, source="test", note="")
    variant = Variant(label="quick", config=load_config(overrides=QUICK))

    def scores(out: str, address: str | None):
        jobs = [Job("clip", tmp_path / "clips", name, variant, tmp_path / out) for name in ("one", "two")]
        outcomes = run_jobs(jobs, 2, address=address)
        assert [outcome.error for outcome in outcomes] == ["", ""]
        measured = [dict(outcome.scores) for outcome in outcomes]
        return [
            {key: value for key, value in one.items() if "second" not in key and "memory" not in key}
            for one in measured
        ]

    assert scores("here", None) == scores("ray", "local")


def test_parts_of_a_long_video_are_tracked_by_all_workers_and_joined(tmp_path):
    clip = synthesize(SyntheticSpec(frames=50, degrees_per_frame=4, size=(200, 160)))
    for index, (image, mask) in enumerate(zip(clip.images, clip.masks, strict=True)):
        for kind, write, content in (("frames", write_image, image), ("masks", write_mask, mask)):
            (tmp_path / kind).mkdir(exist_ok=True)
            write(tmp_path / kind / f"{index:03d}.png", content)
    small = ["crop.size=64", "object.frequency=3", "object.texture_size=64", "camera.fov=45"]
    tracker = {"name": "precomputed", "path": str(tmp_path / "masks")}
    job = VideoJob(
        "long", str(tmp_path / "frames"), load_config(overrides=small, tracker=tracker), split="25f"
    )
    told = []
    progress = run_batch(
        [job], str(tmp_path / "out"), ProcessEngine(2), report=False, listener=told.append, retries=0
    )
    assert progress.finished == 1
    began = {
        one.about["step"]: one.about["worker"]
        for one in told
        if one.about.get("attempt") and one.about.get("step")
    }
    assert began["part 1 of 2"] != began["part 2 of 2"]
    assert began["refinement pass 1 of 2"] != began["refinement pass 2 of 2"]
    run = RunReader(tmp_path / "out/long")
    assert run.state == "finished" and len(run.frames) == 50 and run.description["split"]["alignments"]
    R = np.stack([one.T_cam_obj[:3, :3] for one in run.frames])
    assert aligned_rotation_errors(R, clip.T_cam_obj[:, :3, :3]).mean() < 3
    assert not (tmp_path / "out/long/parts").exists() and not (tmp_path / "out/.work").exists()


def test_a_hundred_tasks_leave_nothing_behind():
    loads = []

    def listener(event):
        if isinstance(event, Ended):
            loads.append(load_now())

    ended = map_tasks(ProcessEngine(2), [Task(number, hold) for number in range(100)], listener=listener)
    assert all(one.value == 16_000_000 for one in ended.values())
    first, last = loads[20:40], loads[80:]
    for name, more in (("own_descriptors", 0), ("descriptors", 10), ("own_memory", 2), ("processes", 0)):
        # Not the most of them: a process that just begins has the open files of the one that it is forked from.
        before, after = (np.median([getattr(one, name) for one in some]) for some in (first, last))
        assert after <= before + more, name
