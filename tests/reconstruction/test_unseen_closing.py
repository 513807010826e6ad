"""A surface is closed within the convex hull of what was seen; oracle: bodies whose hull is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.mirror_symmetry import SymmetryPlane
from tracking3d.reconstruction.seen_regions import close_unseen, pull_into

SIDE = 64


def model_of(mesh: trimesh.Trimesh, seen: np.ndarray) -> ObjectModel:
    """A model with a texel for each face; ``seen`` ``(F,)`` says which were seen."""
    place = np.arange(len(mesh.faces))
    uv = np.stack([place % SIDE, place // SIDE], 1) + 0.5
    weight = np.zeros((SIDE, SIDE), np.float32)
    weight[place // SIDE, place % SIDE] = seen
    return ObjectModel(
        np.asarray(mesh.vertices, np.float64),
        np.asarray(mesh.faces, np.int64),
        np.repeat(uv[:, None] / SIDE, 3, axis=1),
        np.zeros((SIDE, SIDE, 3), np.uint8),
        weight,
        np.zeros((SIDE, SIDE, 1), np.float32),
    )


def balloon() -> tuple[trimesh.Trimesh, np.ndarray]:
    """A cube of side 2 whose three sides at one corner were seen; elsewhere it bulges."""
    mesh = trimesh.creation.box((2, 2, 2)).subdivide().subdivide().subdivide()
    seen = (mesh.triangles_center > 1 - 1e-9).any(1)
    at_seen = np.zeros(len(mesh.vertices), bool)
    at_seen[mesh.faces[seen]] = True
    mesh.vertices[~at_seen] *= 1.8
    return mesh, seen


def test_a_box_seen_at_one_corner_is_five_sixths_of_the_box():
    mesh, seen = balloon()
    assert mesh.volume > 2 * 8
    closed = close_unseen(model_of(mesh, seen))
    assert trimesh.Trimesh(closed.vertices, closed.faces).volume == pytest.approx(8 * 5 / 6, rel=0.03)


def test_what_was_seen_stays_to_the_last_digit():
    mesh, seen = balloon()
    model = model_of(mesh, seen)
    closed = close_unseen(model)
    np.testing.assert_array_equal(closed.vertices[model.faces[seen]], model.vertices[model.faces[seen]])
    np.testing.assert_array_equal(closed.faces, model.faces)


def test_a_second_time_changes_nothing():
    once = close_unseen(model_of(*balloon()))
    np.testing.assert_allclose(close_unseen(once).vertices, once.vertices, atol=1e-12)


def test_a_flat_thing_seen_from_one_side_stays_as_it_is():
    mesh = trimesh.creation.box((2, 2, 0.0)).subdivide().subdivide()
    model = model_of(mesh, np.arange(len(mesh.faces)) % 2 == 0)
    assert close_unseen(model) is model


@pytest.mark.parametrize("seen", [True, False])
def test_without_an_unseen_or_a_seen_part_nothing_changes(seen):
    mesh = trimesh.creation.icosphere(2)
    model = model_of(mesh, np.full(len(mesh.faces), seen))
    assert close_unseen(model) is model


def test_inner_points_stay_and_outer_ones_come_onto_the_body():
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    planes = np.column_stack([sides, np.full(6, -1.0)])
    points = np.array([[0.5, 0.2, -0.9], [3.0, 1.5, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, 0.0]])
    pulled = pull_into(points, np.zeros(3), planes)
    np.testing.assert_allclose(pulled, [[0.5, 0.2, -0.9], [1.0, 0.5, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]])


def test_a_moved_model_is_closed_alike():
    model = model_of(*balloon())
    moved = replace(model, vertices=3 * model.vertices + (5, -2, 1))
    np.testing.assert_allclose(
        close_unseen(moved).vertices, 3 * close_unseen(model).vertices + (5, -2, 1), atol=1e-9
    )


def test_a_speck_that_is_taken_for_seen_holds_nothing():
    mesh, seen = balloon()
    far = int(np.argmin(mesh.triangles_center.sum(1)))
    closed = close_unseen(model_of(mesh, seen | (np.arange(len(seen)) == far)))
    assert trimesh.Trimesh(closed.vertices, closed.faces).volume == pytest.approx(8 * 5 / 6, rel=0.03)


def test_with_a_plane_of_symmetry_the_hull_is_that_of_both_halves():
    mesh, seen = balloon()
    plane = SymmetryPlane(np.array([1.0, 0, 0]), 0.0, 1.0)
    closed = close_unseen(model_of(mesh, seen), [plane])
    assert trimesh.Trimesh(closed.vertices, closed.faces).volume == pytest.approx(8, rel=0.03)
