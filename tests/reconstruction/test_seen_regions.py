"""What was seen is whole regions, and colours go on over the surface."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.geometry.prototypes import sphere
from tracking3d.reconstruction.seen_regions import select_seen_texels, smooth_seen_share, spread_colours

MESH = sphere(8)
CENTRES = MESH.vertices[MESH.faces].mean(1)
FRONT = CENTRES[:, 2] < 0


def face_texels(each: int = 4, seed: int = 0):
    """``each`` texels on every face, at random places."""
    random = np.random.default_rng(seed)
    face = np.repeat(np.arange(len(MESH.faces)), each)
    barycentric = random.dirichlet(np.ones(3), len(face)).astype(np.float32)
    return face, barycentric


def test_single_faces_follow_those_around_them():
    random = np.random.default_rng(1)
    noisy = np.where(random.random(len(FRONT)) < 0.1, ~FRONT, FRONT).astype(float)
    seen = smooth_seen_share(MESH.vertices, MESH.faces, noisy) > 0.5
    inner = np.abs(CENTRES[:, 2]) > 0.15
    assert (noisy > 0.5)[inner].tolist() != FRONT[inner].tolist()
    np.testing.assert_array_equal(seen[inner], FRONT[inner])


def test_an_average_over_the_surface_keeps_the_seen_area():
    share = FRONT.astype(float)
    corners = MESH.vertices[MESH.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    smooth = smooth_seen_share(MESH.vertices, MESH.faces, share)
    assert smooth @ area == pytest.approx(share @ area, rel=0.02)
    assert smooth.min() >= 0 and smooth.max() <= 1


def test_the_texels_of_a_face_are_seen_together():
    face, _ = face_texels()
    shown = FRONT[face] & (np.random.default_rng(2).random(len(face)) < 0.8)
    seen = select_seen_texels(MESH.vertices, MESH.faces, face, shown)
    per_face = seen.reshape(-1, 4)
    assert (per_face.all(1) | ~per_face.any(1)).all()
    inner = np.abs(CENTRES[face, 2]) > 0.15
    np.testing.assert_array_equal(seen[inner], FRONT[face][inner])


def test_faces_without_a_texel_follow_the_others():
    face = np.flatnonzero(np.random.default_rng(5).random(len(FRONT)) < 0.3)
    assert select_seen_texels(MESH.vertices, MESH.faces, face, np.ones(len(face), bool)).all()


def test_colours_go_on_over_the_surface_as_a_membrane_does():
    """Between two rings of known colours at z = -a and z = a, a harmonic function of a sphere is atanh(z)."""
    face, barycentric = face_texels()
    place = np.einsum("nk,nkc->nc", barycentric, MESH.vertices[MESH.faces[face]])
    z = place[:, 2] / np.linalg.norm(place, axis=1)
    shown = np.abs(z) > 0.7
    truth = np.clip(0.5 + 0.5 * np.arctanh(z.clip(-0.7, 0.7)) / np.arctanh(0.7), 0, 1)
    colours = np.repeat(truth[:, None], 3, 1).astype(np.float32)
    spread = spread_colours(MESH.vertices, MESH.faces, face, barycentric, colours * shown[:, None], shown)
    assert spread.shape == ((~shown).sum(), 3)
    apart = np.abs(spread - colours[~shown])
    assert np.median(apart) < 0.03 and apart.max() < 0.15  # faces of unequal size, edges of equal weight


def test_a_piece_that_touches_nothing_known_takes_the_mean():
    count = len(MESH.vertices)
    vertices = np.concatenate([MESH.vertices, MESH.vertices + np.array([5, 0, 0])])
    faces = np.concatenate([MESH.faces, MESH.faces + count])
    face = np.arange(len(faces))
    barycentric = np.full((len(face), 3), 1 / 3, np.float32)
    shown = face < len(MESH.faces)
    colours = np.where(shown[:, None], np.float32((0.2, 0.4, 0.6)), np.float32(0))
    spread = spread_colours(vertices, faces, face, barycentric, colours, shown)
    np.testing.assert_allclose(spread, np.broadcast_to((0.2, 0.4, 0.6), spread.shape), atol=1e-3)


def test_where_all_is_known_nothing_is_left_to_spread():
    face, barycentric = face_texels(1)
    all_shown = np.ones(len(face), bool)
    colours = np.zeros((len(face), 3), np.float32)
    assert spread_colours(MESH.vertices, MESH.faces, face, barycentric, colours, all_shown).shape == (0, 3)
