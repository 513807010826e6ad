"""The uniform Laplacian against one written down by hand."""

from __future__ import annotations

import numpy as np
import torch

from tracking3d.geometry.mesh import uniform_laplacian
from tracking3d.geometry.prototypes import sphere


def test_two_triangles_give_the_matrix_written_down_by_hand():
    # A square 0 1 / 2 3 cut along 1-2: 0 has neighbours 1, 2; 1 has 0, 2, 3; 2 has 0, 1, 3; 3 has 1, 2.
    laplacian = uniform_laplacian(torch.tensor([[0, 2, 1], [1, 2, 3]]), 4).to_dense()
    third = 1 / 3
    expected = [
        [1, -0.5, -0.5, 0],
        [-third, 1, -third, -third],
        [-third, -third, 1, -third],
        [0, -0.5, -0.5, 1],
    ]
    torch.testing.assert_close(laplacian, torch.tensor(expected))


def test_it_is_the_difference_to_the_mean_of_the_neighbours():
    mesh = sphere(3)
    values = np.random.default_rng(0).normal(size=(len(mesh.vertices), 3))
    neighbours = [set() for _ in mesh.vertices]
    for face in mesh.faces:
        for a in face:
            neighbours[a] |= set(face) - {a}
    expected = np.array([values[i] - values[list(around)].mean(0) for i, around in enumerate(neighbours)])
    laplacian = uniform_laplacian(torch.tensor(mesh.faces), len(values)).double()
    np.testing.assert_allclose(torch.sparse.mm(laplacian, torch.tensor(values)), expected, atol=1e-6)


def test_what_is_the_same_everywhere_has_none():
    mesh = sphere(5)
    laplacian = uniform_laplacian(torch.tensor(mesh.faces), len(mesh.vertices))
    assert torch.sparse.mm(laplacian, torch.ones(len(mesh.vertices), 1)).abs().max() < 1e-6


def test_it_is_sparse():
    mesh = sphere(5)
    laplacian = uniform_laplacian(torch.tensor(mesh.faces), len(mesh.vertices))
    assert laplacian.is_sparse
    assert laplacian.values().numel() == len(mesh.vertices) + 3 * len(mesh.faces)
