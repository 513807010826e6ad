"""Pose estimates in the format of the BOP Challenge: ``scene_id,im_id,obj_id,score,R,t,time``.

R holds nine values row by row, t three in millimetres, both separated by spaces; x_cam = R x_obj + t. The official
name of a file is ``METHOD_DATASET-SPLIT.csv``. https://bop.felk.cvut.cz/challenges
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.geometry.alignment import nearest_rigid
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.readers.text_files import read_text
from tracking3d_bench.datasets.truth import Truth

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
"""As `tracking3d.export.bop_poses` writes them, which takes longer to import."""


@dataclass(frozen=True, eq=False)
class _Estimate:
    scene_id: int
    im_id: int
    obj_id: int
    score: float
    T_cam_obj: NDArray[np.float64]
    seconds: float


def answers_from_bop_csv(
    file: Path,
    truth: Truth,
    scene_id: int | None = None,
    obj_id: int | None = None,
    im_ids: Sequence[int] | None = None,
) -> Answers:
    """The best scored pose in each image of one object in one scene.

    Poses are given in the unit of the truth if its length is known, else in millimetres. One that is not rigid is
    left out. Scores are the confidence if all of them are in [0, 1].

    Args:
        file: The table, with or without a header.
        truth: The clip.
        scene_id, obj_id: Which; may be None if the table has only one.
        im_ids: The image of each frame; None takes the numbers that are the frames' names, else their indices.

    Raises:
        InputError: If the table cannot be read, or has no pose of a frame of the clip.
    """
    estimates = _read(file)
    scene_id = _only("scene", scene_id, {one.scene_id for one in estimates}, file)
    estimates = [one for one in estimates if one.scene_id == scene_id]
    obj_id = _only("object", obj_id, {one.obj_id for one in estimates}, file)
    index = {im_id: n for n, im_id in enumerate(_image_numbers(truth) if im_ids is None else im_ids)}
    best: dict[int, _Estimate] = {}
    for one in estimates:
        n = index.get(one.im_id)
        if n is None or n >= len(truth.frames) or one.obj_id != obj_id:
            continue
        if n not in best or one.score > best[n].score:
            best[n] = one
    if not best:
        raise InputError(
            f"{file} has no pose of object {obj_id} in scene {scene_id} for a frame of the clip {truth.name}; "
            "give the scene and the object of the clip."
        )
    scores_are_confidence = all(0 <= one.score <= 1 for one in estimates)
    return Answers(
        origin=file,
        asked=range(len(truth.frames)),
        answered=frozenset(best),
        T_cam_obj={n: _in_units(one.T_cam_obj, truth.millimetres or 1.0) for n, one in best.items()},
        confidence={n: one.score for n, one in best.items()} if scores_are_confidence else {},
        seconds={n: one.seconds for n, one in best.items() if one.seconds >= 0},
    )


def _read(file: Path) -> list[_Estimate]:
    rows = list(csv.reader(read_text(file).splitlines()))
    header = [column.strip() for column in rows[0]] if rows else []
    body = rows[1:] if header == list(COLUMNS) else rows
    estimates = [
        _estimate(file, number, row) for number, row in enumerate(body, 1 + len(rows) - len(body)) if row
    ]
    if not estimates:
        raise InputError(f"{file} has no poses; give a table with the columns {','.join(COLUMNS)}.")
    return estimates


def _estimate(file: Path, number: int, row: list[str]) -> _Estimate:
    try:
        scene_id, im_id, obj_id, score, R, t, seconds = row
        pose = np.eye(4)
        pose[:3, :3] = np.array(R.split(), dtype=np.float64).reshape(3, 3)
        pose[:3, 3] = np.array(t.split(), dtype=np.float64).reshape(3)
        one = _Estimate(int(scene_id), int(im_id), int(obj_id), float(score), pose, float(seconds))
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"Line {number} of {file} is not {','.join(COLUMNS)} with nine numbers in R and three in t; correct it."
        ) from error
    if not np.isfinite(pose).all():
        raise InputError(f"Line {number} of {file} has a pose with values that are not finite; remove it.")
    if (rigid := nearest_rigid(pose, file)) is None:
        raise InputError(f"Line {number} of {file} (image {one.im_id}): R is not a rotation; correct it.")
    one = replace(one, T_cam_obj=rigid)
    if not (math.isfinite(one.score) and math.isfinite(one.seconds)):
        raise InputError(f"Line {number} of {file} has a score or time that is not finite; correct it.")
    return one


def _only(what: str, asked: int | None, known: set[int], file: Path) -> int:
    if asked is None and len(known) == 1:
        return next(iter(known))
    if asked is None:
        raise InputError(f"{file} has {len(known)} {what}s; give the {what} of the clip.")
    if asked not in known:
        raise InputError(f"{file} has no {what} {asked}; it has {', '.join(map(str, sorted(known)[:10]))}.")
    return asked


def _image_numbers(truth: Truth) -> Sequence[int]:
    numeric = all(name.isdecimal() for name in truth.names)
    return [int(name) for name in truth.names] if numeric else range(len(truth.names))


def _in_units(pose: NDArray[np.float64], millimetres: float) -> NDArray[np.float64]:
    pose = pose.copy()
    pose[:3, 3] /= millimetres
    return pose
