"""Symmetries of BOP models: hand-computed turns, the spacing of the BOP challenge, combinations."""

from __future__ import annotations

import numpy as np
import pytest
from written_datasets import write_json

from tracking3d_bench.datasets.bop import read_symmetries


@pytest.fixture
def symmetries(tmp_path):
    def read(largest_step=0.01, **info):
        write_json(tmp_path / "models_info.json", {"1": {"diameter": 100, **info}})
        return read_symmetries(tmp_path / "models_info.json", 1, largest_step)

    return read


AXIS = {"axis": [0, 0, 2], "offset": [10, 0, 5]}
FLIP = np.diag([1.0, -1, -1, 1])


def test_an_object_without_symmetries_has_the_identity(symmetries):
    assert symmetries().tolist() == [np.eye(4).tolist()]


def test_discrete_symmetries_follow_the_identity(symmetries):
    found = symmetries(symmetries_discrete=[FLIP.ravel().tolist()])
    assert found.tolist() == [np.eye(4).tolist(), FLIP.tolist()]


def test_quarter_turns_about_an_axis_beside_the_origin(symmetries):
    found = symmetries(np.pi / 4, symmetries_continuous=[AXIS])
    assert len(found) == 4
    assert (found @ [11, 0, 7, 1])[:, :3] == pytest.approx(
        np.array([[11, 0, 7], [10, 1, 7], [9, 0, 7], [10, -1, 7]])
    )


def test_points_of_the_axis_stay_where_they_are(symmetries):
    found = symmetries(symmetries_continuous=[AXIS])
    assert np.abs(found @ [10, 0, -3, 1] - [10, 0, -3, 1]).max() < 1e-12


def test_from_one_turn_to_the_next_no_point_moves_more_than_a_hundredth_of_the_diameter(symmetries):
    found = symmetries(symmetries_continuous=[{"axis": [1, 1, 0], "offset": [0, 0, 0]}])
    assert len(found) == 315  # ceil(pi / 0.01)
    furthest = 50 * np.array([1, -1, 0, 0]) / np.sqrt(2) + [0, 0, 0, 1]
    moved = np.linalg.norm(np.diff(found @ furthest, axis=0), axis=1)
    assert moved.min() > 0.0099 * 100 and moved.max() <= 0.01 * 100


def test_every_turn_is_combined_with_every_discrete_symmetry(symmetries):
    found = symmetries(np.pi / 4, symmetries_discrete=[FLIP.ravel().tolist()], symmetries_continuous=[AXIS])
    turns = symmetries(np.pi / 4, symmetries_continuous=[AXIS])
    assert len(found) == 8
    assert found == pytest.approx(np.concatenate([turns, turns @ FLIP]))
    assert found[0] == pytest.approx(np.eye(4))
