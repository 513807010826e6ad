"""Makes the picture of shapes from eight sides: that of the online map, the one made anew, and that with its texture.

$ tracking3d model RUN --model fine
$ python docs/images/shape_anew.py RUN picture.jpg
$ python docs/images/shape_anew.py RUN picture.jpg --truth CLIP    # the true shape above them
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tracking3d.datasets.clip import read_truth
from tracking3d.datasets.run_answers import answers_of_run
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.evaluation.pose_scores import fit_alignment, pair_poses
from tracking3d.frames import Image
from tracking3d.results import layout
from tracking3d.results.mesh_export import load_model
from tracking3d.results.mesh_view import render_view

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


def picture(run: Path, clip: Path | None) -> Image:
    """``(N SIDE, SIDES SIDE, 3)``."""
    made, online = load_model(run), load_model(run / layout.ONLINE)
    rows = [grey(online), grey(made), made]
    if clip is not None:
        rows.insert(0, grey(true_shape(run, clip, online)))
    return np.vstack([np.hstack([render_view(one, rotation(n), SIDE) for n in range(SIDES)]) for one in rows])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--truth", type=Path, default=None)
    given = parser.parse_args()
    made = cv2.cvtColor(picture(given.run, given.truth), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(given.out), made, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
