"""The script that fits the confidence reads finished runs, never mixes the halves, and prints the package's table."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.results.files import write_mask
from tracking3d.testing.synthesis.convex_clips import write_clip
from tracking3d_bench.benchmark.job import RUN, Job
from tracking3d_bench.benchmark.variant import Variant

FRAMES = 12
CAMERA = Camera.from_fov(32, 24)


@pytest.fixture(scope="module")
def script():
    file = Path(__file__).resolve().parents[2] / "training" / "confidence.py"
    spec = importlib.util.spec_from_file_location("confidence_training", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def poses(count):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(
        np.c_[np.zeros(count), 0.05 * np.arange(count), np.zeros(count)]
    ).as_matrix()
    T[:, 2, 3] = 4
    return T


@pytest.fixture
def benchmark(tmp_path):
    """Four sequences whose last third is 40 degrees off and has a high loss, apart from one frame of each kind."""
    mask = np.zeros((24, 32), bool)
    mask[5:15, 8:20] = True
    variant = Variant(label="test", config=load_config())
    for number, name in enumerate("abcd"):
        images, true = np.zeros((FRAMES, 24, 32, 3), np.uint8), poses(FRAMES)
        write_clip(
            tmp_path / "clips" / name, images, np.stack([mask] * FRAMES), true, CAMERA, source="t", note=""
        )
        job = Job("clip", tmp_path / "clips", name, variant, tmp_path / "out")
        job.write()
        run = job.folder / RUN
        (run / "masks").mkdir(parents=True)
        config = {"solver": {"name": "online" if number < 3 else "paper"}}
        (run / "run.json").write_text(
            json.dumps(
                {"format": "tracking3d-run", "format_version": 2, "state": "finished"}
                | {"config": config, "camera": asdict(CAMERA)}
            )
        )
        lines = []
        for n in range(FRAMES):
            wrong = n >= 8
            T = true[n].copy()
            if wrong:
                T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([np.radians(40), 0, 0]).as_matrix()
            write_mask(run / "masks" / f"{n:06d}.png", mask)
            loss = 0.5 + 0.01 * n if wrong != (n in (5, 10)) else 0.1 + 0.01 * number
            record = {"index": n, "time": None, "name": "", "T_cam_obj": T.tolist(), "status": "tracked"}
            record |= {"reason": "", "confidence": 0.9, "losses": {"silhouette": loss}, "iterations": 1}
            record |= {"keyframe": False, "seconds": 0.1, "iou_initial": None, "area": 120}
            lines.append(json.dumps(record) + "\n")
        (run / "frames.jsonl").write_text("".join(lines))
    return tmp_path / "out"


def test_what_runs_knew_is_put_beside_what_is_true(script, benchmark):
    frames = list(script.judged_frames(benchmark, None, False))
    assert len(frames) == 4 * (FRAMES - 1)  # the given frame does not count
    assert [one.right for one in frames[: FRAMES - 1]] == [True] * 7 + [False] * 4
    assert frames[0].evidence["has_mask"] == 0 and frames[0].evidence["recorded"] == 0.9
    assert {one.sequence for one in script.judged_frames(benchmark, "online", False)} == {"a", "b", "c"}


def test_the_fit_is_tested_on_the_other_half_and_printed(script, benchmark, tmp_path, capsys):
    file = tmp_path / "coefficients.json"
    script.main([str(benchmark), "--evidence=-silhouette,+has_mask", "--json", str(file)])
    told = capsys.readouterr().out
    assert told.count("fitted on 2 sequences, 22 frames") == 2 and '"intercept": ' in told
    table = json.loads(file.read_text())
    assert table["data"] == "44 frames of 4 sequences" and table["error"].count("calibration error") == 2
    terms = table["terms"]
    assert terms["silhouette"]["weight"] < -2 and terms["has_mask"]["weight"] == 0
    recorded, fitted = _errors(told)
    assert fitted < recorded


def _errors(told):
    found = {}
    for line in told.splitlines():
        for kind in ("recorded:", "fitted:"):
            if line.strip().startswith(kind):
                found.setdefault(kind, float(line.split("calibration error ")[1].split(",")[0]))
    return found["recorded:"], found["fitted:"]


def test_one_sequence_is_not_enough(script, benchmark):
    with pytest.raises(InputError, match="At least two sequences"):
        script.main([str(benchmark), "--solver", "paper"])


def test_with_balance_every_folder_is_tested_by_a_fit_on_the_others(script, benchmark, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(benchmark, other)
    file = tmp_path / "coefficients.json"
    script.main(
        [str(benchmark), str(other), "--balance", "--evidence=-silhouette,recorded_odds", "--json", str(file)]
    )
    told = capsys.readouterr().out
    assert [line.split(":")[0] for line in told.splitlines() if " frames, " in line] == ["other", "out"]
    terms = json.loads(file.read_text())["terms"]
    assert terms["silhouette"]["weight"] < -2 and terms["recorded_odds"]["weight"] == 0  # it never differs
    with pytest.raises(InputError, match="At least two folders"):
        script.main([str(benchmark), "--balance", "--evidence=silhouette"])


def test_a_frame_of_a_large_group_counts_less(script):
    frames = [script.Judged("s", group, {}, True, 0.0) for group in "aaaab"]
    assert script.balanced(frames).tolist() == [0.5, 0.5, 0.5, 0.5, 1.0]
