"""Views that share few landmarks are not tied together by them: those of two sides of a card are mistaken."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tracking3d.points.bundle import bundle
from tracking3d.points.landmarks import tied_together

FRONT, BACK, MISTAKEN = slice(0, 60), slice(60, 120), slice(120, 125)
INTRINSICS = np.tile([300.0, 300.0, 80.0, 60.0], (8, 1))


def of_a_card() -> np.ndarray:
    """``(8, 125)``: four views of each side, and five landmarks that all eight hold."""
    known = np.zeros((8, 125), bool)
    known[:4, FRONT], known[4:, BACK], known[:, MISTAKEN] = True, True, True
    return known


def test_few_landmarks_in_common_count_on_one_side_only():
    tied = tied_together(of_a_card())
    assert tied[:4, FRONT].all() and tied[4:, BACK].all()
    assert (tied[:4, MISTAKEN].all(0) ^ tied[4:, MISTAKEN].all(0)).all()
    assert not (tied[:4, MISTAKEN] & tied[4:, MISTAKEN]).any()


def test_views_in_a_row_that_share_landmarks_with_their_neighbours_only_are_one_group():
    known = np.stack([np.isin(np.arange(200), np.arange(20 * view, 20 * view + 60)) for view in range(8)])
    assert not known[0, known[7]].any()
    assert (tied_together(known) == known).all()


def test_views_without_landmarks_stay_so():
    known = of_a_card()
    known[2] = False
    tied = tied_together(known)
    assert not tied[2].any() and tied[3, FRONT].all()
    assert not tied_together(np.zeros((3, 0), bool)).size


def test_a_side_does_not_turn_against_the_other_for_what_was_mistaken():
    """Round after round, each held to what the last one made of the points, as the final refinement does it."""
    random = np.random.default_rng(1)
    points = random.uniform(-1, 1, (125, 3)) * [1, 1, 0.02]
    T = np.tile(np.eye(4), (8, 1, 1))
    turns = Rotation.from_rotvec(np.deg2rad(np.outer([0, 10, 20, 30, 180, 190, 200, 210], [0, 1, 0])))
    T[:, :3, :3], T[:, 2, 3] = turns.as_matrix(), 6.0
    wrong = points.copy()
    wrong[MISTAKEN] = points[MISTAKEN] @ Rotation.from_euler("y", 8, degrees=True).as_matrix().T
    measured = np.concatenate([projected(points, T[:4]), projected(wrong, T[4:])])

    def turned(known: np.ndarray) -> float:
        found, poses = points, T
        for _ in range(12):
            rounds = bundle(found, INTRINSICS, poses, measured, np.where(known, 0.3, np.inf), 0.1)
            found, poses = rounds.points, rounds.T_cam_obj
        moved = Rotation.from_matrix(T[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3])
        return float(np.rad2deg((moved[:4].mean().inv() * moved[4:].mean()).magnitude()))

    assert turned(tied_together(of_a_card())) < 0.1
    assert turned(of_a_card()) > 5


def projected(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    seen = points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    return seen[..., :2] / seen[..., 2:] * INTRINSICS[0, :2] + INTRINSICS[0, 2:]
