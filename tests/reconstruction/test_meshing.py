"""Surfaces of volumes are closed, of the right topology, and have an atlas that can be drawn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

pytest.importorskip("skimage")
pytest.importorskip("fast_simplification")
pytest.importorskip("xatlas")

from tracking3d.reconstruction.grid import Grid
from tracking3d.reconstruction.meshing import (
    cell_atlas,
    extract_surface,
    is_sound,
    main_pieces,
    simplify,
    unwrap,
)
from tracking3d.rendering import TexelMap


@pytest.fixture(scope="module")
def ring() -> trimesh.Trimesh:
    """A torus, and a crumb beside it."""
    grid = Grid.around(np.array([[-1.5, -1.5, -0.5], [1.5, 1.5, 0.5]]), 40, 0.1)
    x, y, z = grid.points.T
    tube = 0.35 - np.hypot(np.hypot(x, y) - 1, z)
    crumb = 0.12 - np.linalg.norm(grid.points, axis=1)
    return extract_surface(grid, np.maximum(tube, crumb))


def test_a_handle_stays_and_a_crumb_goes(ring):
    assert len(ring.split()) == 2
    whole = main_pieces(ring)
    assert is_sound(whole) and whole.euler_number == 0
    assert np.abs(np.hypot(np.hypot(*whole.vertices[:, :2].T) - 1, whole.vertices[:, 2]) - 0.35).max() < 0.02


def test_simpler_is_still_sound(ring):
    simple = simplify(main_pieces(ring), 600)
    assert is_sound(simple) and len(simple.faces) <= 700 and simple.euler_number == 0
    assert simple.volume == pytest.approx(main_pieces(ring).volume, rel=0.03)


def test_what_reaches_the_edge_of_the_grid_is_closed():
    grid = Grid.around(np.array([[-1.0, -1, -1], [1, 1, 1]]), 8, 0.0)
    assert is_sound(extract_surface(grid, np.ones(np.prod(grid.shape), np.float32)))
    assert extract_surface(grid, -np.ones(np.prod(grid.shape), np.float32)) is None


@pytest.mark.parametrize("made_by", ["cells", "xatlas"])
def test_every_face_has_texels_of_its_own(ring, made_by):
    mesh = simplify(main_pieces(ring), 600)
    if made_by == "cells":
        uvs, size = cell_atlas(len(mesh.faces))
    else:
        uvs, size = unwrap(np.asarray(mesh.vertices), np.asarray(mesh.faces)), 512
    assert uvs.min() >= 0 and uvs.max() <= 1
    texels = TexelMap.of(torch.from_numpy(uvs).float(), size)
    assert len(np.unique(texels.face.numpy())) > 0.97 * len(mesh.faces)
    assert (texels.barycentric > -1e-3).all()
