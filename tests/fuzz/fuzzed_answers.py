"""Somebody else's results and truths to score: damaged, of other sizes, of other frames."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
from damaging import pick, spoil, word
from judging import Case
from PIL import Image

IDENTITY = np.eye(4)


def answers(case: Case) -> None:
    """Score odd answers, or sound ones against an odd truth."""
    truth = case.material.copy("truth", case.folder)
    if case.random.random() < 0.5:
        _spoil_truth(case, truth)
        given = (
            case.material.copy("masks", case.folder)
            if case.random.random() < 0.5
            else case.material.copy("run", case.folder)
        )
    else:
        given = pick(case.random, [_masks, _csv, _trajectory, _pickle, _colmap])(case)
    if (given / "frames.jsonl").exists():
        (given / "untouched").touch()
    as_json = ["--json"] if case.random.random() < 0.3 else []
    case.command("evaluate", "answers", given, "--truth", truth, *as_json)


def _spoil_truth(case: Case, truth: Path) -> None:
    files = sorted(path for path in truth.rglob("*") if path.is_file())
    poses = truth / "poses.json"
    if case.random.random() < 0.5:
        case.story.append(spoil(pick(case.random, files), case.random))
        return
    text = poses.read_text()
    data = json.loads(text)
    key = pick(case.random, list(data))
    data[key] = pick(
        case.random, [None, [], {}, 5, "x", [None], {"0": None}, {"x": [[1]]}, [[1, 2], [3]], 1e308]
    )
    case.story.append(f"poses.json {key} = {data[key]!r}")
    poses.write_text(json.dumps(data))


def _masks(case: Case) -> Path:
    folder = case.material.copy("masks", case.folder)
    for file in sorted(folder.iterdir()):
        chance = case.random.random()
        if chance < 0.3:
            case.story.append(spoil(file, case.random))
        elif chance < 0.5:
            file.rename(folder / f"{int(case.random.integers(0, 10**9))}.png")
        elif chance < 0.7:
            Image.new("L", pick(case.random, [(1, 1), (640, 480), (48, 64)]), 255).save(file)
    return folder


def _csv(case: Case) -> Path:
    file = case.folder / "answers.csv"
    rows = ["scene_id,im_id,obj_id,score,R,t,time"]
    for number in range(4):
        R = " ".join(
            str(value) for value in pick(case.random, [IDENTITY[:3, :3].ravel(), [1, 2], ["nan"] * 9, ["x"]])
        )
        rows.append(f"0,{pick(case.random, [number, -1, 'x', 10**20])},1,{word(case.random)!r},{R},0 0 1,1")
    file.write_text(
        pick(case.random, ["\n".join(rows), "\n".join(rows[1:]), rows[0], "", ",,,"]), "utf-8", "replace"
    )
    return file


def _trajectory(case: Case) -> Path:
    file = case.folder / "answers.txt"
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for number in range(4):
        quaternion = pick(
            case.random, ["0 0 0 1", "0 0 0 0", "nan 0 0 1", "1e308 1e308 0 0", "0 0", "a b c d"]
        )
        rows.append(f"{pick(case.random, [number, 'x', -5, 1e300, number / 25])} 0 0 1 {quaternion}")
    file.write_text("\n".join(rows))
    return file


def _pickle(case: Case) -> Path:
    file = case.folder / "answers.pkl"
    shapes = [(5, 3, 2), (5, 3), (0, 3, 2), (5, 900, 2)]
    data = {
        "video": case.material.clip.images,
        "points": np.zeros(pick(case.random, shapes)),
        "occluded": np.zeros((5, 3), bool),
    }
    file.write_bytes(pickle.dumps(pick(case.random, [data, {"a": data}, [], None, {"x": print}, Path("x")])))
    if case.random.random() < 0.3:
        case.story.append(spoil(file, case.random))
    return file


def _colmap(case: Case) -> Path:
    folder = case.folder / "model"
    folder.mkdir()
    (folder / "cameras.txt").write_text(
        pick(case.random, ["1 PINHOLE 64 48 50 50 32 24\n", "1 ODD 1 1\n", "", "x"])
    )
    line = pick(
        case.random,
        ["1 1 0 0 0 0 0 1 1 000000.png\n\n", "1 0 0 0 0 0 0 1 1 a.png\n\n", "1 x\n", "", "nan " * 10],
    )
    (folder / "images.txt").write_text(line)
    (folder / "points3D.txt").write_text(pick(case.random, ["", "1 0 0 0 1 1 1 0\n", "x y z\n"]))
    return folder
