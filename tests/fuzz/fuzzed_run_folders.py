"""Run folders in which a file is damaged, missing, or holds what it should not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from damaging import pick, spoil, word
from judging import Case, check_folders

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1.5, 1e308, 10**30, "x", "", "0", [], {}, [1], {"a": 1}, [[]], "NaN", [None] * 4,
    float("nan"), float("inf"), [[1, 0], [0, 1]], "tracked", "../../etc",
)  # fmt: skip


def run_folders(case: Case) -> None:
    """Spoil a finished run and let every reader at it."""
    folder = case.material.copy("run", case.folder)
    (folder / "untouched").touch()
    for _ in range(int(case.random.integers(1, 3))):
        pick(case.random, [_file, _file, _description, _description, _line, _line, _features])(case, folder)
    pick(case.random, [_points, _points, _score, _score, _report, _compare, _over])(case, folder)


def _file(case: Case, folder: Path) -> None:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "untouched")
    if files:
        case.story.append(spoil(pick(case.random, files), case.random))


def _description(case: Case, folder: Path) -> None:
    _change(case, folder / "run.json")


def _line(case: Case, folder: Path) -> None:
    file = folder / "frames.jsonl"
    if not file.is_file():
        return
    lines = file.read_text("utf-8", "replace").splitlines()
    if not lines:
        return
    number = int(case.random.integers(len(lines)))
    kind = int(case.random.integers(6))
    try:
        record = json.loads(lines[number])
    except ValueError:
        return
    if kind == 0:
        lines[number] = lines[number][: int(case.random.integers(len(lines[number])))]
    elif kind == 1:
        lines.insert(number, pick(case.random, ["", "null", "[]", "5", "{}", word(case.random), "{" * 3000]))
    elif isinstance(record, dict) and record:
        key = pick(case.random, list(record))
        if kind == 2:
            del record[key]
        else:
            record[key] = pick(case.random, VALUES)
        case.story.append(f"frames.jsonl {number} {key} = {record.get(key)!r}")
        lines[number] = json.dumps(record)
    file.write_text("\n".join(lines) + "\n", "utf-8", "replace")


def _change(case: Case, file: Path) -> None:
    """Change one value anywhere in a JSON file."""
    try:
        data = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        return
    if not isinstance(data, dict) or not data:
        return
    inner, path = data, []
    while True:
        key = pick(case.random, list(inner))
        path.append(key)
        if isinstance(inner[key], dict) and inner[key] and case.random.random() < 0.8:
            inner = inner[key]
            continue
        break
    if case.random.random() < 0.2:
        del inner[key]
    else:
        inner[key] = pick(case.random, VALUES)
    case.story.append(f"{file.name} {path} = {inner.get(key, 'deleted')!r}")
    file.write_text(json.dumps(data), "utf-8")


def _features(case: Case, folder: Path) -> None:
    file = folder / "features.npz"
    try:
        with np.load(file) as arrays:
            kept = dict(arrays)
    except Exception:
        return
    key = pick(case.random, list(kept))
    odd = [
        np.zeros(0),
        np.array(3),
        np.array("x"),
        np.full((2, 2), np.nan),
        kept[key][:1],
        kept[key] * np.nan,
    ]
    odd += [kept[key].astype(complex), kept[key].ravel(), np.full_like(kept[key], 10**6)]
    kept[key] = pick(case.random, odd)
    case.story.append(f"features.npz {key} = {kept[key].dtype} {kept[key].shape}")
    np.savez(file, **kept)


def _points(case: Case, folder: Path) -> None:
    case.command("points", folder, "--xy", "32,24", "--frame", pick(case.random, [0, 0, 1, 2, 7]))


def _score(case: Case, folder: Path) -> None:
    case.command("evaluate", "answers", folder, "--truth", case.material.folder / "truth")


def _report(case: Case, folder: Path) -> None:
    case.command("report", folder)


def _compare(case: Case, folder: Path) -> None:
    case.command("compare", case.material.copy("run", case.folder / "whole"), folder, "--out", "differ.html")


def _over(case: Case, folder: Path) -> None:
    """A run into the folder, and one that may replace what is there."""
    case.run(case.material.folder / "images", "--out", folder)
    if case.run(case.material.folder / "images", "--out", folder, "--overwrite") == 0:
        (folder / "untouched").unlink()
        check_folders(folder)
