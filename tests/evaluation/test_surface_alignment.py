"""Surfaces say how large and where a shape is, from where poses say to begin."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d_bench.evaluation.surface_alignment import align_surfaces


def box():
    return trimesh.creation.box((1.0, 0.7, 0.4)).subdivide().subdivide()


def similarity(scale, degrees, shift):
    T = np.eye(4)
    T[:3, :3] = scale * Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    T[:3, 3] = shift
    return T


@pytest.mark.parametrize("scale", [0.3, 0.75, 1.3, 3.0])
def test_a_shape_of_another_size_is_brought_to_size(scale):
    true, T = box(), similarity(scale, 5.0, (0.1, -0.05, 0.02))
    estimated = true.copy().apply_transform(T)
    found = align_surfaces(estimated, true, 1.3, np.eye(4))
    assert min(np.abs(fit @ T - np.eye(4)).max() for fit in found) < 0.01


def test_a_part_that_nobody_saw_has_no_say():
    true = box()
    horn = trimesh.creation.box((0.1, 0.1, 1.5), trimesh.transformations.translation_matrix((0, 0, -0.9)))
    estimated = trimesh.util.concatenate([true, horn]).apply_scale(1.1)
    found, _ = align_surfaces(estimated, true, 1.3, np.eye(4), lambda points, normals: normals[:, 2] > -0.5)
    assert np.cbrt(np.linalg.det(found[:3, :3])) == pytest.approx(1 / 1.1, abs=0.01)
