"""Surfaces of volumes are closed, of the right topology, and have an atlas that can be drawn."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from packaging.requirements import Requirement

pytest.importorskip("skimage")
pytest.importorskip("fast_simplification")

from tracking3d.reconstruction.meshing import (
    Grid,
    cell_atlas,
    extract_surface,
    is_sound,
    main_pieces,
    simplify,
    unwrap,
)
from tracking3d.reconstruction.rebuild import has_packages
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
        pytest.importorskip("xatlas")
        uvs, size = unwrap(np.asarray(mesh.vertices), np.asarray(mesh.faces)), 512
    assert uvs.min() >= 0 and uvs.max() <= 1
    texels = TexelMap.of(torch.from_numpy(uvs).float(), size)
    assert len(np.unique(texels.face.numpy())) > 0.97 * len(mesh.faces)
    assert (texels.barycentric > -1e-3).all()


def test_without_xatlas_every_two_faces_have_a_chart_and_that_is_told(ring, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    uvs = unwrap(np.asarray(ring.vertices), np.asarray(ring.faces))
    np.testing.assert_array_equal(uvs, cell_atlas(len(ring.faces))[0])
    assert "xatlas is not installed" in caplog.text
    assert has_packages()


@pytest.mark.parametrize(
    ("python", "system", "machine", "asked"),
    [
        ("3.12", "linux", "x86_64", True),
        ("3.12", "linux", "aarch64", False),
        ("3.12", "darwin", "arm64", True),
        ("3.14", "win32", "AMD64", False),
    ],
)
def test_xatlas_is_asked_for_only_where_it_has_wheels(python, system, machine, asked):
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    [needed] = [one for one in map(Requirement, project["dependencies"]) if one.name == "xatlas"]
    where = {"python_version": python, "sys_platform": system, "platform_machine": machine}
    assert (needed.marker is None or needed.marker.evaluate(where)) is asked
