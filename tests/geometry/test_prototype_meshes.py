"""Prototypes: the icosphere, its atlas, ellipsoids."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.prototypes import ellipsoid, equirectangular_uvs, icosphere, sphere
from tracking3d.rendering import render


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def uv_areas(mesh: Mesh) -> np.ndarray:
    """Signed area of every face in the atlas; positive if it turns like its face seen from outside."""
    a, b = mesh.face_uvs[:, 1] - mesh.face_uvs[:, 0], mesh.face_uvs[:, 2] - mesh.face_uvs[:, 0]
    return -0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])  # v runs down


def test_the_papers_icosphere_has_1212_vertices_and_2420_faces():
    mesh = sphere()
    assert mesh.vertices.shape == (1212, 3) and mesh.vertices.dtype == np.float64
    assert mesh.faces.shape == (2420, 3) and mesh.faces.dtype == np.int64
    assert mesh.face_uvs.shape == (2420, 3, 2) and mesh.face_uvs.dtype == np.float64


@pytest.mark.parametrize("frequency", [1, 2, 3, 4, 7, 11, 12])
def test_an_icosphere_is_a_closed_outward_oriented_unit_sphere(frequency):
    mesh = sphere(frequency)
    assert len(mesh.vertices) == 10 * frequency**2 + 2
    assert len(mesh.faces) == 20 * frequency**2
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0)
    ball = solid(mesh)
    assert ball.is_watertight and ball.is_winding_consistent
    assert ball.euler_number == 2
    normals = np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2)))
    assert (np.einsum("fd,fd->f", normals, mesh.vertices[mesh.faces].mean(1)) > 0).all()


def test_the_faces_of_the_icosphere_are_of_similar_size():
    areas = solid(sphere()).area_faces
    assert areas.max() < 2.5 * areas.min()


@pytest.mark.parametrize("frequency", [1, 2, 3, 4, 11])
def test_every_face_is_small_in_the_atlas_and_turned_like_on_the_surface(frequency):
    mesh = sphere(frequency)
    across, down = np.ptp(mesh.face_uvs[..., 0], axis=1), np.ptp(mesh.face_uvs[..., 1], axis=1)
    # Five faces meet at a pole and share its whole row; no face spans the atlas.
    assert across.max() < 0.2 + 1e-9
    assert down.max() < 0.42 / frequency
    assert (uv_areas(mesh) > 0).all()


def test_the_faces_cover_the_atlas_once():
    mesh = sphere()
    # All but half of the row of triangles at each pole.
    assert 0.97 < uv_areas(mesh).sum() < 1.0
    assert mesh.face_uvs[..., 1].min() == 0.0 and mesh.face_uvs[..., 1].max() == 1.0
    assert mesh.face_uvs[..., 0].min() >= 0.0


@pytest.mark.parametrize("frequency", [3, 11])
def test_texture_coordinates_of_neighbours_agree_along_their_edge_but_for_the_poles(frequency):
    mesh = sphere(frequency)
    seen: dict[tuple[int, int], np.ndarray] = {}
    for face, uvs in zip(mesh.faces, mesh.face_uvs, strict=True):
        for i in range(3):
            j = (i + 1) % 3
            low, high = sorted((i, j), key=lambda k: face[k])
            poles = abs(mesh.vertices[face[[low, high]], 1]) > 1 - 1e-9
            uv = uvs[[low, high]].copy()
            uv[:, 0] = np.where(poles, 0, (uv[:, 0] + 1e-9) % 1)  # the atlas wraps; a pole has every u
            other = seen.setdefault((face[low], face[high]), uv)
            np.testing.assert_allclose(uv, other, atol=1e-9)


def test_the_atlas_is_longitude_and_latitude_with_the_near_side_in_its_middle():
    mesh = sphere(4)
    corner, uv = mesh.vertices[mesh.faces].reshape(-1, 3), mesh.face_uvs.reshape(-1, 2)
    off_pole = abs(corner[:, 1]) < 1 - 1e-9
    longitude, latitude = 2 * np.pi * (uv[:, 0] - 0.5), np.pi * (uv[:, 1] - 0.5)
    expected = np.stack(
        [np.cos(latitude) * np.sin(longitude), np.sin(latitude), -np.cos(latitude) * np.cos(longitude)], 1
    )
    np.testing.assert_allclose(corner[off_pole], expected[off_pole], atol=1e-9)


def test_the_texture_is_seen_upright_and_not_mirrored():
    mesh = sphere(6)
    K = torch.tensor([[[60.0, 0, 31.5], [0, 60.0, 31.5], [0, 0, 1]]])
    drawn = render(
        torch.tensor(mesh.vertices).float(),
        torch.tensor(mesh.faces),
        torch.tensor(mesh.face_uvs).float(),
        torch.zeros(1, 4, 4),
        torch.eye(3)[None],
        torch.tensor([[0.0, 0.0, 4.0]]),
        K,
        (64, 64),
    )
    uv = torch.full((64, 64, 2), torch.nan)
    uv.reshape(-1, 2)[drawn.pixels] = drawn.uv
    assert uv[32, 32].tolist() == pytest.approx([0.5, 0.5], abs=0.02)
    assert (uv[32, 24:40, 0].diff() > 0).all()  # u grows to the right
    assert (uv[24:40, 32, 1].diff() > 0).all()  # v grows downwards


def test_faces_across_the_seam_reach_beyond_one_instead_of_back_to_zero():
    mesh = sphere(4)
    behind = (mesh.vertices[mesh.faces][..., 2] > 0).all(1)
    x = mesh.vertices[mesh.faces][..., 0]
    across = behind & (x.min(1) < -0.01) & (x.max(1) > 0.01)
    across &= ~(abs(mesh.vertices[mesh.faces][..., 1]) > 1 - 1e-9).any(1)
    assert across.any()
    assert (mesh.face_uvs[across][..., 0].max(1) > 1).all()
    assert (mesh.face_uvs[across][..., 0].min(1) > 0.5).all()


def test_a_corner_on_a_pole_takes_the_mean_of_the_others():
    vertices = np.array([[0.0, -1.0, 0.0], [0.1, -0.9, 0.2], [-0.1, -0.9, 0.2], [0.0, 0.0, 0.0]])
    (corner,) = equirectangular_uvs(vertices, np.array([[0, 1, 2]]))
    assert corner[0, 0] == pytest.approx(corner[1:, 0].mean())
    assert corner[0, 1] == 0
    # The origin has no direction at all, and still a place in the atlas.
    assert np.isfinite(equirectangular_uvs(vertices, np.array([[3, 1, 2]]))).all()


def test_an_ellipsoid_is_the_sphere_stretched_and_then_turned():
    rotation = Rotation.from_rotvec([10, 20, 30], degrees=True).as_matrix()
    axes = np.array([2.0, 1.0, 0.5])
    mesh = ellipsoid(axes, rotation, 5)
    back = mesh.vertices @ rotation / axes
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1.0)
    assert np.array_equal(mesh.faces, sphere(5).faces)
    assert np.array_equal(mesh.face_uvs, sphere(5).face_uvs)
    assert solid(mesh).volume > 0


def test_the_same_sphere_comes_out_every_time():
    (a, b), (c, d) = icosphere(5), icosphere(5)
    assert np.array_equal(a, c) and np.array_equal(b, d)
