"""Jobs run in processes of their own: one that crashes costs itself only, and what is finished stays."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import contextmanager

import pytest

from tracking3d.engines.choosing import InThisProcess
from tracking3d_bench.benchmark import job as job_module
from tracking3d_bench.benchmark import pool
from tracking3d_bench.benchmark.fingerprint import hashed_sources
from tracking3d_bench.benchmark.job import Job
from tracking3d_bench.benchmark.pool import run_jobs


@pytest.fixture
def jobs(clips, tmp_path):
    def make(variant, sequences=("narrow", "wide")):
        return [Job("clip", clips, name, variant, tmp_path / "out") for name in sequences]

    return make


@pytest.mark.slow
def test_a_crash_and_a_failure_cost_their_own_sequence_only_and_the_rest_is_found_again(jobs, scripted):
    told = []
    narrow, wide = run_jobs(jobs(scripted(crash=70)), 2, told.append)
    assert narrow.error == "" and narrow.scores["iou_mean"] > 0.3
    assert wide.scores is None and "signal 11" in wide.error and "log.txt" in wide.error
    assert {outcome.job.sequence for outcome in told} == {"narrow", "wide"}

    [again] = run_jobs(jobs(scripted(crash=70), ["narrow"]), 1)
    assert again.cached and again.scores == json.loads(json.dumps(narrow.scores))


def test_the_memory_of_a_refined_run_is_that_of_the_first_pass_and_both_its_answers_are_scored(
    jobs, scripted
):
    [job] = jobs(scripted(), ["narrow"])
    assert job.config.solver.final_refine
    job.write()
    scores = job_module.run_job(job)
    assert len(json.loads((job.folder / job_module.MEMORY).read_text())) == 3
    assert scores["causal"]["frames"] == scores["frames"] == 3


def test_a_job_tells_whether_memory_grew_and_scores_both_answers_of_a_refined_run(jobs, scripted):
    [job] = jobs(scripted().with_changes("causal", solver__final_refine=False), ["narrow"])
    job.write()
    scores = job_module.run_job(job)
    held = json.loads((job.folder / job_module.MEMORY).read_text())
    assert len(held) == 3 and min(held) > 50
    assert scores["memory_growth_mb"] == pytest.approx(max(held[1:]) - held[0])
    assert scores["causal"] is None

    lines = (job.folder / job_module.RUN / "frames.jsonl").read_text().splitlines()
    lost = json.loads(lines[-1]) | {"refined": True, "status": "lost"}
    causal = json.loads(lines[-1])["status"] == "lost"
    (job.folder / job_module.RUN / "frames.jsonl").write_text("\n".join([*lines, json.dumps(lost)]) + "\n")
    scores = job_module.run_job(job)
    assert scores["frames_lost"] == scores["causal"]["frames_lost"] + 1 - causal
    assert scores["memory_growth_mb"] == scores["causal"]["memory_growth_mb"] is not None


def test_growth_is_what_the_second_half_holds_more_at_most():
    assert job_module.memory_growth([10, 30, 20, 25, 28, 33]) == 3
    assert job_module.memory_growth([10, 30, 20, 25]) == -5
    assert job_module.memory_growth([10]) is None and job_module.memory_growth([]) is None


def test_a_failure_is_told_in_its_own_sentence(jobs, scripted):
    [outcome] = run_jobs(jobs(scripted(fail=70), ["wide"]))
    told = r"mask tracker 'scripted' \(TRACKING3D_PLUGINS [0-9a-f]+\) failed at 000000.png: RuntimeError"
    assert re.match(told, outcome.error)


def test_a_sequence_that_cannot_be_read_is_an_outcome(jobs, scripted):
    [outcome] = run_jobs(jobs(scripted(), ["absent"]))
    assert outcome.scores is None and "absent" in outcome.error


def test_equal_jobs_are_done_once(jobs, scripted, monkeypatch):
    done = []

    def run(tell, file) -> None:
        done.append(Job.read(file))
        job_module.run_job(done[-1])

    @contextmanager
    def here(address, workers):
        yield InThisProcess()

    monkeypatch.setattr(pool, "_run_written", run)
    monkeypatch.setattr(pool, "open_engine", here)
    first, second = run_jobs(jobs(scripted(), ["narrow"]) + jobs(scripted("another label"), ["narrow"]), 2)
    assert sorted([first.cached, second.cached]) == [False, True]
    assert first.scores == second.scores
    assert len(done) == 1


def test_what_a_result_depends_on_is_in_its_key(jobs, scripted, clips, tmp_path, monkeypatch):
    [one] = jobs(scripted(), ["narrow"])
    folder, score_key = one.folder, one.score_key
    assert jobs(scripted(crash=99), ["narrow"])[0].folder != folder
    assert jobs(scripted(masks="truth"), ["narrow"])[0].folder != folder
    assert jobs(scripted("label"), ["narrow"])[0].folder == folder

    shutil.copy(clips / "narrow/frames/000000.png", clips / "narrow/frames/000003.png")
    assert jobs(scripted(), ["narrow"])[0].folder != folder
    (clips / "narrow/frames/000003.png").unlink()

    with monkeypatch.context() as newer:
        newer.setattr(job_module, "plugin_versions", lambda *names: [("scripted", "somebody", "2.0")])
        assert jobs(scripted(), ["narrow"])[0].folder != folder

    code = job_module.code_fingerprint
    monkeypatch.setattr(job_module, "code_fingerprint", lambda judges: code(judges=judges) + "x" * judges)
    [rescored] = jobs(scripted(), ["narrow"])
    assert rescored.folder == folder and rescored.score_key != score_key
    monkeypatch.setattr(job_module, "code_fingerprint", lambda judges: code(judges=judges) + "x")
    assert jobs(scripted(), ["narrow"])[0].folder != folder


def test_the_camera_of_the_dataset_is_used_unless_the_settings_say_one(jobs, scripted):
    [one] = jobs(scripted().with_changes("unsaid", camera__fov=None), ["narrow"])
    camera = one.truth.camera
    assert one.config.camera.intrinsics == (camera.fx, camera.fy, camera.cx, camera.cy)
    [other] = jobs(scripted().with_changes("fov", camera__fov=30.0), ["narrow"])
    assert (other.config.camera.intrinsics, other.config.camera.fov) == (None, 30.0)


def test_a_job_survives_its_way_through_a_file(jobs, scripted):
    [one] = jobs(scripted(masks="truth"), ["wide"])
    assert Job.read(one.write()) == one


def test_runs_are_found_again_for_the_same_package_and_scores_for_the_same_measures():
    runs, scores = ({name for name, _ in hashed_sources(judges=judges)} for judges in (False, True))
    assert {"estimation/estimate.py", "geometry/alignment.py", "config/presets/default.yaml"} <= runs
    assert {"evaluation/score.py", "datasets/clip.py", "datasets/layouts/clip.yaml"} <= scores
    assert not any(name.startswith(("cli/", "benchmark/", "speed/")) for name in runs | scores)
