"""``tracking3d evaluate``: its commands, what they print and keep, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize, write_clip
from tracking3d_bench.benchmark import suite as suite_module
from tracking3d_bench.benchmark.pool import JobOutcome
from tracking3d_bench.benchmark.results import ResultSet, write_results


@pytest.fixture(scope="module")
def clip():
    return synthesize(SyntheticSpec(frames=3, size=(64, 48), supersample=1))


@pytest.fixture
def clips(clip, tmp_path):
    """A folder of two clips with truth."""
    for name in ("one", "two"):
        poses, camera = clip.T_cam_obj, clip.camera
        write_clip(tmp_path / "clips" / name, clip.images, clip.masks, poses, camera, source="test", note="")
    return tmp_path / "clips"


@pytest.fixture
def jobs(monkeypatch):
    """Answer every job at once: IoU 0.8 with preset paper and 0.9 else; the sequence ``two`` may fail."""
    asked, failing = [], []

    def run(jobs, processes, listener, address=None):
        outcomes = []
        for job in jobs:
            asked.append(job)
            iou = 0.8 if job.variant.label.startswith("paper") else 0.9
            scores = {
                "iou_initial_mean": 0.7,
                "iou_mean": iou + 0.01 * len(job.sequence),
                "rotation_error_mean_deg": None,
                "frames_lost": 0,
            }
            if job.variant.config.solver.name == "online":
                scores["causal"] = {**scores, "iou_mean": scores["iou_mean"] - 0.02}
            failed = job.sequence in failing
            outcomes.append(JobOutcome(job, None if failed else scores, "it crashed" if failed else ""))
            listener(outcomes[-1])
        return outcomes

    monkeypatch.setattr(suite_module, "run_jobs", run)
    run.asked, run.failing = asked, failing
    return run


def test_a_suite_is_run_printed_and_kept(call, clips, jobs):
    result = call("evaluate", "suite", "real", "--data", clips, "--masks", "degraded:0.7", "--jobs", 2)
    assert result.exit_code == 0, result.output
    assert [job.sequence for job in jobs.asked] == ["one", "two"]
    assert "0.930" in result.stdout
    kept = json.loads(Path("benchmark/results/default_masks_degraded_0_7-real.json").read_text())
    assert kept["mean"]["iou_mean"] == pytest.approx(0.93)
    assert (kept["masks"], kept["config"]["tracker"]["name"]) == ("degraded:0.7", "auto")


def test_a_sequence_that_fails_is_named_and_the_others_are_kept(call, clips, jobs):
    jobs.failing.append("two")
    result = call("evaluate", "suite", "real", "--data", clips, "--label", "mine")
    assert result.exit_code == 1
    assert "two failed: it crashed" in result.stderr
    kept = json.loads(Path("benchmark/results/mine-real.json").read_text())
    assert kept["errors"] == {"two": "it crashed"} and kept["sequences"]["one"]["iou_mean"] > 0.9


def test_a_fresh_suite_is_drawn_from_its_seed_and_kept_apart(call, clips, jobs, monkeypatch):
    asked = []

    def make(name, folder, *, specs, **named):
        asked.append((name, folder, specs and [spec.seed for spec in specs]))
        return made(clips)

    monkeypatch.setattr("tracking3d_bench.benchmark.sequences.make_suite", make)
    for seed in (9000, 9001):
        fresh = ("evaluate", "suite", "fresh", "--seed", seed, "--count", 5, "--label", "mine")
        result = call(*fresh)
        assert result.exit_code == 0, result.output
        assert "95% interval" in result.stdout
        assert Path(f"benchmark/results/mine-fresh-{seed}.json").is_file()
    assert [(name, folder) for name, folder, _ in asked] == [
        (f"fresh-{seed}", Path(f"benchmark/data/fresh-{seed}")) for seed in (9000, 9001)
    ]
    assert [len(seeds) for _, _, seeds in asked] == [5, 5] and not set(asked[0][2]) & set(asked[1][2])
    compared = call(
        "evaluate", "compare", *[f"benchmark/results/mine-fresh-{seed}.json" for seed in (9000, 9001)]
    )
    assert compared.exit_code == 2 and "of different data" in compared.stderr
    assert call("evaluate", "compare", "paper", "default", "--suite", "fresh-9000").exit_code == 0
    assert asked[-1] == ("fresh-9000", Path("benchmark/data/fresh-9000"), None)


def test_only_the_sequences_that_match_are_run(call, clips, jobs, refused):
    call("evaluate", "suite", "real", "--data", clips, "--sequence", "t*")
    assert [job.sequence for job in jobs.asked] == ["two"]
    words = refused("evaluate", "suite", "real", "--data", clips, "--sequence", "three")
    assert "no sequence 'three'" in words and "one, two" in words


def test_a_table_is_printed_and_written_in_three_formats(call, clips, jobs, monkeypatch):
    monkeypatch.setattr(
        "tracking3d_bench.benchmark.sequences.make_suite", lambda name, folder, **named: made(clips)
    )
    arguments = ("evaluate", "table", "keyframes", "--data", clips, "--initial", f"ostrack={clips}")
    words = call(*arguments)  # the layout of CDTB finds nothing in clips of our own
    assert words.exit_code == 2
    preset = ("--preset", "rerendering")  # only its solver has keyframes to choose the number of
    result = call("evaluate", "table", "keyframes", *preset, "--json", "--plot", "keyframes.svg")
    assert result.exit_code == 0, result.output
    lines = json.loads(result.stdout)["lines"]
    assert [line["label"] for line in lines] == [str(count) for count in range(1, 11)]
    assert lines[5]["paper"] == 0.7404 and lines[5]["here"] == pytest.approx(0.93)
    assert {path.name for path in Path("benchmark/tables").iterdir()} == {
        f"keyframes{suffix}" for suffix in (".md", ".csv", ".json")
    }
    assert Path("keyframes.svg").read_text().startswith("<?xml")


def test_the_solvers_are_put_side_by_side_with_causal_and_refined_answers(call, clips, jobs):
    arguments = ("evaluate", "table", "online", "--data", clips, "--masks", "noise:3", "--row", "*RGB")
    result = call(*arguments, "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["columns"] == ["paper, RGB", "online, RGB, causal", "online, RGB, refined"]
    assert document["sequences"] == ["one", "two"]
    assert document["means"]["iou_mean"] == pytest.approx(
        {"paper, RGB": 0.83, "online, RGB, causal": 0.91, "online, RGB, refined": 0.93}
    )
    assert {job.variant.masks for job in jobs.asked} == {"noise:3"}
    assert {path.name for path in Path("benchmark/tables").iterdir()} == {
        f"online{suffix}" for suffix in (".md", ".csv", ".json")
    }
    assert Path("benchmark/results/online-online_rgb-noise_3-real.json").is_file()
    assert "0.910" in call(*arguments).stdout


def test_the_answers_of_a_run_that_are_scored_can_be_chosen(call, clips, script, tmp_path):
    assert call("run", clips / "one/frames", "--box", "20,10,20,20", "--out", "run").exit_code == 0
    records = [json.loads(line) for line in Path("run/frames.jsonl").read_text().splitlines()]
    refined = [record | {"refined": True, "status": "lost"} for record in records]
    with Path("run/frames.jsonl").open("a") as file:
        file.writelines(json.dumps(record) + "\n" for record in refined)

    def lost(*more):
        return json.loads(call("evaluate", "run", "--truth", clips / "one", "--json", *more).stdout)[
            "frames_lost"
        ]

    assert (lost(), lost("--answers", "final"), lost("--answers", "causal")) == (3, 3, 0)


def test_a_run_that_was_interrupted_is_scored_and_called_so(call, clips, script, tmp_path):
    assert call("run", clips / "one/frames", "--box", "20,10,20,20", "--out", "run").exit_code == 0
    scored = "evaluate", "run", "--truth", clips / "one"
    assert "interrupted" not in call(*scored).stderr
    described = json.loads(Path("run/run.json").read_text())
    Path("run/run.json").write_text(json.dumps(described | {"state": "interrupted"}))
    assert "The run in run is interrupted; frames estimated so far: 3." in call(*scored).stderr


def made(clips):
    return sorted(clips.iterdir())


def results(label, values):
    scores = {f"s{n}": {"iou_mean": float(value)} for n, value in enumerate(values)}
    return ResultSet(label, "standard", scores, {}, {})


def test_two_files_of_results_are_compared(call, tmp_path):
    values = np.linspace(0.5, 0.8, 6)
    write_results(results("A", values), tmp_path / "a.json")
    write_results(results("B", values + 0.05), tmp_path / "b.json")
    [found] = json.loads(call("evaluate", "compare", "a.json", "b.json", "--json").stdout)
    assert found["verdict"] == "B is better" and found["low"] == pytest.approx(0.05)
    printed = call("evaluate", "compare", "a.json", "b.json").stdout
    assert "B is better" in printed and "+0.050" in printed


def test_two_presets_are_run_and_compared(call, clips, jobs):
    result = call("evaluate", "compare", "paper", "default", "--suite", "real", "--data", clips)
    assert result.exit_code == 0, result.output
    assert len(jobs.asked) == 4
    assert "B is better" in result.stdout


def test_results_of_others_are_scored_and_said_to_be_recognised(call, clips):
    result = call("evaluate", clips / "one/masks", "--truth", clips / "one")
    assert result.exit_code == 0, result.output
    assert "is read as" in result.stderr
    scores = json.loads(call("evaluate", clips / "one/masks", "--truth", clips / "one", "--json").stdout)
    assert scores["iou_mean"] == 1 and scores["iou_initial_mean"] is None
    assert scores["rotation_error_mean_deg"] is None


def test_an_option_of_a_format_is_handed_on(call, clips, refused, tmp_path):
    poses = json.loads((clips / "one/poses.json").read_text())["frames"]
    lines = []
    for number, pose in enumerate(poses.values()):
        R, t = np.array(pose["R"]), np.array(pose["t"])
        q = Rotation.from_matrix(R.T).as_quat()
        lines.append(" ".join(str(value) for value in (number, *(-R.T @ t), *q)))
    (tmp_path / "slam.txt").write_text("\n".join(lines))
    arguments = ("evaluate", "slam.txt", "--truth", clips / "one")
    scores = json.loads(call(*arguments, "--option", "of=camera", "--json").stdout)
    assert scores["rotation_error_max_deg"] == pytest.approx(0, abs=1e-4)
    assert json.loads(call(*arguments, "--json").stdout)["rotation_error_max_deg"] > 1
    assert "no such option" in refused(*arguments, "--option", "off=camera")
    assert "--option of is not KEY=VALUE" in refused(*arguments, "--option", "of")


def test_colmap_is_a_peer_whose_unregistered_frames_are_lost(call, clips, tmp_path):
    poses = json.loads((clips / "one/poses.json").read_text())["frames"]
    lines = []
    for number, name in enumerate(list(poses)[:2], 1):
        x, y, z, w = Rotation.from_matrix(poses[name]["R"]).as_quat()
        numbers = " ".join(str(value) for value in (w, x, y, z, *poses[name]["t"]))
        lines += [f"{number} {numbers} 1 {name}.png", ""]
    (tmp_path / "model").mkdir()
    (tmp_path / "model/images.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "model/cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    (tmp_path / "model/points3D.txt").write_text("")
    result = call("evaluate", "peer", "colmap", "model", "--truth", clips / "one", "--json")
    scores = json.loads(result.stdout)
    assert scores["frames_lost"] == 1 and scores["rotation_error_max_deg"] == 180
    assert scores["rotation_error_median_deg"] == pytest.approx(0, abs=1e-4)


def test_colmap_is_run_on_a_clip_and_a_run_stands_beside_it(call, refused, clips, monkeypatch):
    from tracking3d_bench.benchmark import peer
    from tracking3d_bench.datasets.answers import Answers

    def found(truth, asked, *, lowered):
        poses = {n: truth.T_cam_obj[n] for n in asked} if lowered else {}
        return Answers(Path("colmap"), asked, frozenset(asked), T_cam_obj=poses), 1.0

    monkeypatch.setattr(peer, "run_colmap", found)
    arguments = ("evaluate", "peer", "colmap", "--truth", clips / "one", "--frames", "::2")
    own, lower = json.loads(call(*arguments, "--json").stdout)
    assert (own["views"], own["placed"], own["mean_deg"]) == (2, 0, 180)
    assert (lower["views"], lower["within_10_deg"]) == (2, 2)
    assert "lower thresholds" in call(*arguments).stdout
    assert "leave out MODEL" in refused(*arguments[:3], "model", *arguments[3:])


def test_the_answers_of_others_are_not_causal_or_final(refused, clips):
    arguments = ("evaluate", clips / "one/masks", "--truth", clips / "one", "--answers", "causal")
    assert "is no run folder, so it has no causal answers" in refused(*arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("evaluate suite nothing --data .", "nothing"),
        ("evaluate suite real", "--data DIR"),
        ("evaluate suite real --data absent", "absent"),
        ("evaluate suite smoke --masks often", "'often' are unknown"),
        ("evaluate suite smoke --preset absent", "no preset 'absent'"),
        ("evaluate table nothing", "no table 'nothing'"),
        ("evaluate table cdtb --initial d3s", "--initial d3s"),
        ("evaluate table cdtb --masks truth", "takes no --masks"),
        ("evaluate table online --initial d3s=.", "takes no --initial"),
        ("evaluate table online --plot a.svg", "takes no --plot"),
        ("evaluate table online --masks noise:x", "'noise:x' name no pixels"),
        ("evaluate table cdtb --plot a.bmp", ".svg"),
        ("evaluate compare a.json b.json", "a.json is not a result set"),
        ("evaluate compare a.json paper", "not one of each"),
        ("evaluate peer slam model --truth .", "'slam' is unknown"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(refused, arguments, words):
    assert words in refused(*arguments.split())
