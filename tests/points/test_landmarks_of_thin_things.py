"""What is followed round the edge of a card is no landmark of both its sides."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tracking3d.points.landmark_adjustment import of_one_side
from tracking3d.points.robust_bundle import bundle

ANGLES = np.array([0, 10, 20, 80, 100, 180, 190, 200])
INTRINSICS = np.tile([300.0, 300.0, 80.0, 60.0], (len(ANGLES), 1))


def turning() -> np.ndarray:
    """A card before the camera: four views of its front, four of its back."""
    T = np.tile(np.eye(4), (len(ANGLES), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.deg2rad(np.outer(ANGLES, [0, 1, 0]))).as_matrix()
    T[:, 2, 3] = 6.0
    return T


def triangles_at(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A small triangle in the plane of the card around every point: vertices and triangles."""
    vertices = points[:, None] + 0.1 * np.array([[0, 1, 0], [1, -1, 0], [-1, -1, 0]])
    return vertices.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3)


def test_a_face_is_seen_from_the_side_of_its_first_view_whichever_way_round_it_is():
    points = np.random.default_rng(0).uniform(-1, 1, (6, 3)) * [1, 1, 0]
    vertices, triangles = triangles_at(points)
    triangles[::2] = triangles[::2, ::-1]
    begins = np.array([0, 1, 3, 4, 6, 7])
    front = of_one_side(turning(), vertices, triangles, begins)
    assert front[:4, :3].all() and not front[4:, :3].any()
    assert front[4:, 3:].all() and not front[:4, 3:].any()


def test_a_side_does_not_turn_against_the_other_for_what_was_mistaken():
    """Round after round, each held to what the last one made of the points, as the final refinement does it."""
    points = np.random.default_rng(1).uniform(-1, 1, (125, 3)) * [1, 1, 0.02]
    begins = np.repeat([1, 6, 2], [60, 60, 5])
    T = turning()
    wrong = points.copy()
    wrong[120:] = points[120:] @ Rotation.from_euler("y", 8, degrees=True).as_matrix().T
    measured = np.concatenate([projected(points, T[:4]), projected(wrong, T[4:])])
    known = np.ones((len(T), len(points)), bool)
    known[4:, :60] = known[:4, 60:120] = False

    def turned(known: np.ndarray) -> float:
        found, poses = points, T
        for _ in range(12):
            rounds = bundle(found, INTRINSICS, poses, measured, np.where(known, 0.3, np.inf), 0.1)
            found, poses = rounds.points, rounds.T_cam_obj
        moved = Rotation.from_matrix(T[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3])
        return float(np.rad2deg((moved[:4].mean().inv() * moved[4:].mean()).magnitude()))

    assert turned(known) > 5
    assert turned(known & of_one_side(T, *triangles_at(points), begins)) < 0.1


def projected(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    seen = points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    return seen[..., :2] / seen[..., 2:] * INTRINSICS[0, :2] + INTRINSICS[0, 2:]
