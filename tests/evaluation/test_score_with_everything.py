"""A sequence of which everything is known: perfect answers score perfectly, in whatever object frame and unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("embreex", reason="the extra synth is not installed")

from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.evaluation.score import score
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.writing import write_sequence

FRAMES = 6


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequence") / "mug"
    spec = SequenceSpec(
        object="mug", motion="tumble", degrees_per_frame=12, frames=FRAMES, size=(96, 72), supersample=1
    )
    write_sequence(folder, spec)
    return read_truth(folder)


@pytest.fixture
def perfect(truth):
    def points(frame, xy):
        asked = [int(np.nanargmin(np.linalg.norm(truth.points.positions[frame] - one, axis=1))) for one in xy]
        return truth.points.positions[:, asked], truth.points.visible[:, asked]

    return Answers(
        origin=truth.frames[0].parent,
        asked=range(FRAMES),
        answered=frozenset(range(FRAMES)),
        given=0,
        masks=truth.masks,
        initial_masks=truth.masks,
        T_cam_obj=truth.T_cam_obj,
        confidence=dict.fromkeys(range(FRAMES), 1.0),
        seconds=dict.fromkeys(range(FRAMES), 0.25),
        mesh=truth.mesh.read,
        points=points,
    )


PERFECT = {
    "iou_mean": 1,
    "boundary_f_mean": 1,
    "iou_gain_percent": 0,
    "rotation_error_max_deg": 0,
    "share_under_5_deg": 1,
    "translation_error_mean_percent": 0,
    "bop_ar": 1,
    "points_average_jaccard": 1,
    "points_delta_average": 1,
    "points_occlusion_accuracy": 1,
    "shape_f_score": 1,
    "confidence_calibration_error": 0,
    "frames_truly_lost": 0,
    "seconds_per_frame": 0.25,
}


def test_perfect_answers_score_perfectly(perfect, truth):
    scores = score(perfect, truth)
    assert {name: getattr(scores, name) for name in PERFECT} == pytest.approx(PERFECT, abs=1e-3)
    assert scores.chamfer_percent < 0.3  # the gaps between the samples
    assert scores.points > 50


def test_the_object_frame_and_the_unit_do_not_matter(perfect, truth):
    A = Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix()
    scale, offset = 3.7, np.array([0.2, -0.5, 0.1])
    T_other_obj = np.eye(4)  # from the true object frame to another one, in a unit 3.7 times as long
    T_other_obj[:3, :3], T_other_obj[:3, 3] = A / scale, offset

    def pose(T):
        moved = np.eye(4)
        moved[:3, :3] = T[:3, :3] @ A.T
        moved[:3, 3] = T[:3, 3] / scale - moved[:3, :3] @ offset
        return moved

    moved = replace(
        perfect,
        T_cam_obj={n: pose(T) for n, T in perfect.T_cam_obj.items()},
        mesh=lambda: truth.mesh.read().apply_transform(T_other_obj),
    )
    scores = score(moved, truth)
    assert {name: getattr(scores, name) for name in PERFECT} == pytest.approx(PERFECT, abs=1e-3)
    assert scores.chamfer_percent < 0.3  # the gaps between the samples


def test_a_turn_that_is_wrong_in_one_frame_costs_that_frame(perfect, truth):
    wrong = dict(perfect.T_cam_obj)
    wrong[4] = wrong[4].copy()
    wrong[4][:3, :3] = Rotation.from_rotvec([0, 0, np.radians(40)]).as_matrix() @ wrong[4][:3, :3]
    scores = score(replace(perfect, T_cam_obj=wrong), truth)
    assert scores.rotation_error_max_deg == pytest.approx(40, abs=1e-3)
    assert scores.rotation_error_mean_deg == pytest.approx(40 / FRAMES, abs=1e-3)
    assert scores.share_under_5_deg == pytest.approx(5 / 6)
    assert 5 / 6 - 1e-9 <= scores.bop_ar_mssd < 1
    assert scores.frames_truly_lost == 1 and scores.lost_recall == 0
    assert scores.confidence_calibration_error == pytest.approx(
        1 / 5
    )  # four of five were right, all were sure


def test_a_frame_without_an_answer_is_wrong_everywhere(perfect, truth):
    def without(values):
        return {n: value for n, value in values.items() if n != 3}

    gone = replace(
        perfect,
        answered=perfect.answered - {3},
        masks=without(perfect.masks),
        T_cam_obj=without(perfect.T_cam_obj),
    )
    scores = score(gone, truth)
    assert scores.frames_missing == 1
    assert scores.iou_mean == pytest.approx(4 / 5) and scores.iou_initial_mean == 1
    assert scores.rotation_error_max_deg == 180
    assert scores.bop_ar == pytest.approx(5 / 6)
    assert scores.lost_recall == 1  # saying nothing is saying that it is lost


def test_what_a_method_does_not_estimate_is_unknown(perfect, truth):
    masks_only = replace(perfect, T_cam_obj=None, mesh=None, points=None, confidence={}, initial_masks=None)
    scores = score(masks_only, truth)
    assert scores.iou_mean == 1 and scores.iou_initial_mean is None and scores.iou_gain_percent is None
    for name in ("rotation_error_mean_deg", "bop_ar", "chamfer_percent", "points_average_jaccard"):
        assert getattr(scores, name) is None
    assert scores.confidence_calibration_error is None and scores.vot_f_score is None


def test_without_depth_there_is_no_vsd_and_no_average_recall(perfect, truth):
    scores = score(perfect, replace(truth, depth={}))
    assert (scores.bop_ar, scores.bop_ar_vsd, scores.bop_ar_mssd) == (None, None, 1)


def test_points_of_an_object_with_an_axis_of_symmetry_cannot_be_told_apart_and_are_not_scored(truth, perfect):
    symmetric = replace(truth, symmetry_axis=np.array([0.0, 1.0, 0.0]))
    scores = score(perfect, symmetric)
    assert scores.points_average_jaccard is None and scores.points == 0
    assert scores.rotation_error_max_deg == pytest.approx(0, abs=1e-4) and scores.bop_ar == pytest.approx(1)
