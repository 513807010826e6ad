"""What of a surface frames show."""

from __future__ import annotations

import numpy as np
import trimesh

from tracking3d.geometry.camera import Camera
from tracking3d_bench.evaluation.seen_surface import make_visibility_test


def test_a_frame_shows_the_front_of_a_ball_and_nothing_behind_another():
    ball, other = trimesh.creation.icosphere(3), trimesh.creation.icosphere(3)
    both = trimesh.util.concatenate([ball, other.apply_translation([0, 0, 4.0])])
    away = np.eye(4)
    away[2, 3] = 6.0
    camera = Camera.from_fov(200, 200, 50.0)
    points, face = trimesh.sample.sample_surface(both, 2000, seed=0)
    points = np.asarray(points)
    seen = make_visibility_test(both, 6.0, [away, np.full((4, 4), np.nan)], camera)(
        points, both.face_normals[face]
    )
    front = points[:, 2] < -0.3
    assert seen[front].all()
    assert not seen[(points[:, 2] > 0) & (points[:, 2] < 2)].any()  # its own back
    hidden = (points[:, 2] > 2) & (np.hypot(*points[:, :2].T) < 0.8)
    assert hidden.any() and not seen[hidden].any()
    assert not make_visibility_test(both, 6.0, [], camera)(points, both.face_normals[face]).any()
