"""Makes the picture of a run's shapes from eight sides: the online one, the final one, and that with its texture.

$ tracking3d model RUN --model fine
$ python docs/images/eight_sides.py RUN picture.jpg
$ python docs/images/eight_sides.py RUN picture.jpg --truth CLIP    # the true shape above them
$ python docs/images/eight_sides.py RUN picture.jpg --beside EARLIER ALONE    # models of several runs, with texture

EARLIER is the run that RUN extends, ALONE one of RUN's video alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.frames import Image
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction.rebuild import EXTENDS
from tracking3d.results import layout
from tracking3d.results.contact_sheet import render_view
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.datasets.run_answers import answers_of_run
from tracking3d_bench.evaluation.pose_scores import fit_alignment, pair_poses

SIDES, SIDE, TILT = 8, 150, 20.0
GREY, QUALITY = 190, 88


def rotation(n: int) -> np.ndarray:
    """``(3, 3)`` from the object's axes, y down, to those of a camera on its ``n``-th side, above or below by turns."""
    turn, tilt = 2 * np.pi * n / SIDES, np.radians(TILT if n % 2 == 0 else -TILT)
    about_y = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    return about_x @ about_y


def grey(model: ObjectModel) -> ObjectModel:
    """The shape without its texture."""
    return replace(
        model, texture=np.full_like(model.texture, GREY), texture_weight=np.ones_like(model.texture_weight)
    )


def true_shape(run: Path, clip: Path, like: ObjectModel) -> ObjectModel:
    """The true mesh in the coordinates of the run."""
    truth = read_truth(clip)
    T_est_true = np.linalg.inv(fit_alignment(pair_poses(answers_of_run(run, truth), truth), None).T_true_est)
    mesh = truth.mesh.read()
    return replace(
        like,
        vertices=mesh.vertices @ T_est_true[:3, :3].T + T_est_true[:3, 3],
        faces=np.asarray(mesh.faces, np.int64),
        face_uvs=np.full((len(mesh.faces), 3, 2), 0.5),
    )


def in_coordinates_of(run: Path, other: Path) -> ObjectModel:
    """The model of another run in the coordinates of a run that extends it, or of one of the same video."""
    model, note = load_model(other), RunReader(run).description.get(EXTENDS) or {}
    if Path(note.get("run", "")).resolve() != other.resolve():
        return model
    similarity = Similarity(np.array(note["R"]), note["scale"], np.array(note["translation"]))
    return replace(model, vertices=similarity.points(model.vertices))


def from_eight_sides(models: Sequence[ObjectModel]) -> Image:
    """A row for each model."""
    return np.vstack(
        [np.hstack([render_view(one, rotation(n), SIDE) for n in range(SIDES)]) for one in models]
    )


def picture(run: Path, clip: Path | None) -> Image:
    """``(N SIDE, SIDES SIDE, 3)``."""
    made, online = load_model(run), load_model(run / layout.ONLINE)
    rows = [grey(online), grey(made), made]
    if clip is not None:
        rows.insert(0, grey(true_shape(run, clip, online)))
    return from_eight_sides(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--truth", type=Path, default=None)
    parser.add_argument("--beside", type=Path, nargs="+", default=())
    given = parser.parse_args()
    if given.beside:
        others = [in_coordinates_of(given.run, other) for other in given.beside]
        drawn = from_eight_sides([*others, load_model(given.run)])
    else:
        drawn = picture(given.run, given.truth)
    made = cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(given.out), made, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
