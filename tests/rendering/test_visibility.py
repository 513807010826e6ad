"""Which face is seen where, against ray casting, and what must never happen at shared edges."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from implementations import TORCH64, everywhere, in_float32
from render_oracle import cast_rays, certain
from scenes import Scene, bumpy_sphere, rounded, triangles
from scipy.ndimage import binary_fill_holes

from tracking3d.rendering import Visibility, rasterize
from tracking3d.rendering.visibility import nearest_depth


def seen(scene: Scene) -> Visibility:
    return rasterize(scene.screen, scene.depth, scene.faces, scene.size, scene.backend)


def assert_seen_as_cast(scene: Scene) -> None:
    """The faces and depths where the rays meet them; in float32 wherever rounding cannot change the answer."""
    visibility = seen(scene)
    assert torch.equal(visibility.pixels, torch.nonzero(visibility.face_index.flatten() >= 0)[:, 0])
    assert torch.equal(visibility.depth.isinf(), visibility.face_index < 0)
    exact = scene.screen.dtype == torch.float64
    for view, (screen, depth) in enumerate(zip(scene.screen.double(), scene.depth.double(), strict=True)):
        rays = screen.numpy(), depth.numpy(), scene.faces.numpy(), scene.size
        expected = cast_rays(*rays)
        sure = np.ones(scene.size, bool) if exact else certain(*rays)
        assert sure.mean() > 0.8
        assert np.array_equal(visibility.face_index[view].numpy()[sure], expected.face_index[sure])
        np.testing.assert_allclose(
            visibility.depth[view].numpy()[sure], expected.depth[sure], rtol=1e-9 if exact else 1e-4
        )


@everywhere
@pytest.mark.parametrize("size", [(24, 24), (13, 31), (33, 10), (1, 1), (1, 40)])
@pytest.mark.parametrize("seed", range(4))
def test_random_triangles_are_seen_where_rays_meet_them(seed, size, by):
    assert_seen_as_cast(triangles(seed, size).by(by))


@everywhere
@pytest.mark.parametrize("spread", [0.01, 0.03, 3.0])
def test_tiny_and_huge_triangles_are_seen_where_rays_meet_them(spread, by):
    assert_seen_as_cast(triangles(7, faces=60, spread=spread).by(by))


@everywhere
@pytest.mark.parametrize("size", [(40, 40), (28, 45)])
def test_a_closed_mesh_is_seen_where_rays_meet_it(size, by):
    assert_seen_as_cast(bumpy_sphere(size).scene.by(by))


@everywhere
def test_a_mesh_that_reaches_out_of_the_picture_is_cut_off(by):
    scene = bumpy_sphere().scene
    moved = rounded(scene.screen + torch.tensor([22.0, -19.0]))
    assert_seen_as_cast(replace(scene, screen=moved).by(by))


@everywhere
def test_nothing_is_seen_of_a_mesh_outside_the_picture(by):
    scene = bumpy_sphere().scene.by(by)
    for away in ([500.0, 0.0], [-500.0, 0.0], [0.0, 500.0], [0.0, -500.0]):
        visibility = seen(replace(scene, screen=scene.screen + torch.tensor(away)))
        assert (visibility.face_index == -1).all()
        assert visibility.depth.isposinf().all()
        assert visibility.pixels.shape == (0,)


@everywhere
def test_no_faces_at_all_leave_the_picture_empty(by):
    scene = bumpy_sphere().scene.by(by)
    visibility = seen(replace(scene, faces=scene.faces[:0], size=(5, 7)))
    assert visibility.face_index.shape == visibility.depth.shape == (2, 5, 7)
    assert (visibility.face_index == -1).all() and visibility.depth.isposinf().all()


@everywhere
def test_one_view_is_seen_as_among_others(by):
    scene = triangles(5, views=3).by(by)
    together = seen(scene)
    for view in range(3):
        one = slice(view, view + 1)
        alone = seen(replace(scene, screen=scene.screen[one], depth=scene.depth[one]))
        assert torch.equal(alone.face_index, together.face_index[one])
        assert torch.equal(alone.depth, together.depth[one])
        by_itself = nearest_depth(
            scene.screen[view], scene.depth[view], scene.faces, scene.size, scene.backend
        )
        assert torch.equal(by_itself, together.depth[view])


@everywhere
def test_no_views_at_all_are_no_exception(by):
    scene = triangles(5).by(by)
    none = seen(replace(scene, screen=scene.screen[:0], depth=scene.depth[:0]))
    assert none.face_index.shape == (0, 24, 24) and none.pixels.shape == (0,)


@everywhere
@pytest.mark.parametrize("depth", [-2.0, -1e-9, 0.0, 5e-4])
def test_faces_with_a_vertex_behind_the_camera_or_before_the_near_plane_are_left_out(depth, by):
    scene = triangles(1, views=1).by(by)
    scene.depth[0, ::9] = depth  # of every third face
    assert_seen_as_cast(scene)
    assert not np.isin(seen(scene).face_index, np.arange(0, 24, 3)).any()


@everywhere
def test_faces_seen_from_behind_are_left_out(by):
    scene = triangles(2, views=1).by(by)
    front = seen(scene).face_index
    back = seen(replace(scene, faces=scene.faces.flip(1))).face_index
    assert not set(front.unique().tolist()) & set(back[back >= 0].tolist())
    assert (front >= 0).any() and (back >= 0).any()


@everywhere
def test_degenerate_faces_are_never_seen(by):
    scene = triangles(3, views=1, spread=0.6).by(by)
    scene.screen[0, 0:3] = torch.tensor([[2.0, 3.0], [10.0, 3.0], [18.0, 3.0]])  # a line
    scene.screen[0, 3:6] = torch.tensor([12.0, 12.0])  # a point
    faces = scene.faces.clone()
    faces[2] = torch.tensor([6, 6, 8])  # a corner twice
    index = seen(replace(scene, faces=faces)).face_index
    assert not np.isin(index, [0, 1, 2]).any()
    assert (index >= 0).any()


@everywhere
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_vertices_that_are_not_finite_spoil_only_their_own_faces(bad, by):
    scene = triangles(4, views=1, faces=6).by(by)
    expected = seen(replace(scene, faces=scene.faces[1:])).face_index
    scene.screen[0, 1] = bad
    index = seen(scene).face_index
    others = torch.where(index > 0, index - 1, -1)
    assert torch.equal(others[index != 0], expected[index != 0])


@everywhere
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e20])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_vertices_are_every_pixel_shows_a_face_that_exists_or_none(seed, bad, by):
    generator = torch.Generator().manual_seed(seed)
    scene = triangles(seed, views=60, faces=4).by(by)
    hit = torch.rand(scene.screen.shape, generator=generator) < 0.15
    sign = torch.where(torch.rand(hit.shape, generator=generator) < 0.5, 1, -1)
    visibility = seen(replace(scene, screen=torch.where(hit, bad * sign, scene.screen)))
    assert set(visibility.face_index.unique().tolist()) == {-1, 0, 1, 2, 3}
    assert torch.equal(visibility.pixels, torch.nonzero(visibility.face_index.flatten() >= 0)[:, 0])
    assert not visibility.depth.isnan().any()


@everywhere
def test_a_face_infinitely_far_away_is_not_seen(by):
    corner = torch.tensor([[[0.0, 0.0], [0.0, 9.0], [9.0, 0.0]]], dtype=by.dtype)
    depth = torch.full((1, 3), math.inf, dtype=by.dtype)
    visibility = rasterize(corner, depth, torch.tensor([[0, 1, 2]]), (10, 10), by.backend)
    assert (visibility.face_index == -1).all() and visibility.depth.isposinf().all()


@everywhere
def test_a_triangle_too_small_for_its_area_to_have_an_inverse_harms_nobody(by):
    small = 1e-20 if by.dtype == torch.float32 else 1e-155
    corner = torch.tensor([[[0.0, 0.0], [0.0, small], [small, 0.0]]], dtype=by.dtype)
    visibility = rasterize(
        corner, torch.ones_like(corner[..., 0]), torch.tensor([[0, 1, 2]]), (4, 4), by.backend
    )
    assert visibility.face_index.max() <= 0
    assert torch.equal(visibility.pixels, torch.nonzero(visibility.face_index.flatten() >= 0)[:, 0])
    assert not visibility.depth.isnan().any()


@everywhere
def test_huge_triangles_far_away_are_not_seen(by):
    for far in (1e8, 1e18, 1e19, 1e25):
        corner = torch.tensor([[far, 0.0], [far, 10.0], [2 * far, 0.0]], dtype=by.dtype)
        for place in (corner, -corner.flip(0), corner.flip(0, 1), -corner.flip(1)):
            faces = torch.tensor([[0, 1, 2]])
            visibility = rasterize(place[None], torch.ones(1, 3, dtype=by.dtype), faces, (9, 9), by.backend)
            assert (visibility.face_index == -1).all()


def grid(cells: int, snapped: bool, seed: int) -> Scene:
    """A square cut into triangles that share all edges, inner vertices shaken."""
    rng = np.random.default_rng(seed)
    line = np.linspace(-0.37, 30.41, cells + 1)
    x, y = np.meshgrid(line, line)
    inner = (abs(x - 15) < 15) & (abs(y - 15) < 15)
    shake = 0.35 * 30 / cells
    x, y = (axis + inner * rng.uniform(-shake, shake, axis.shape) for axis in (x, y))
    points = np.stack([x, y], 2).reshape(-1, 2)
    if snapped:
        points = np.round(points)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    right, below, across = corner + 1, corner + cells + 1, corner + cells + 2
    faces = np.concatenate([np.stack([corner, below, right], 1), np.stack([right, below, across], 1)])
    faces = np.stack([np.roll(face, rng.integers(3)) for face in faces])
    return Scene(
        torch.tensor(points)[None],
        torch.ones(1, len(points), dtype=torch.float64),
        torch.tensor(rng.permutation(faces)),
        (31, 31),
    )


@everywhere
@pytest.mark.parametrize("snapped", [False, True], ids=["anywhere", "at pixel centres"])
@pytest.mark.parametrize("seed", range(6))
def test_neighbours_leave_no_crack_between_them(seed, snapped, by):
    assert (seen(grid(6, snapped, seed).by(by)).face_index >= 0).all()


@everywhere
@pytest.mark.parametrize("seed", range(6))
def test_no_pixel_between_neighbours_is_hit_twice(seed, by):
    scene = grid(6, False, seed).by(by)
    hits = torch.zeros(31, 31)
    for face in scene.faces:
        hits += seen(replace(scene, faces=face[None])).face_index[0] >= 0
    assert (hits == 1).all()


@everywhere
def test_a_closed_mesh_has_no_holes_from_any_side(by):
    mesh = bumpy_sphere((96, 96), views=8, frequency=11).scene.by(by)
    for scene in (mesh, replace(mesh, screen=mesh.screen.round())):
        for mask in seen(scene).face_index >= 0:
            assert mask.any()
            assert np.array_equal(mask, binary_fill_holes(mask))


@everywhere
def test_a_pixel_on_a_shared_edge_or_vertex_belongs_to_the_lower_of_equally_near_faces(by):
    scene = grid(5, True, 0).by(by)
    alone = torch.stack([seen(replace(scene, faces=face[None])).face_index[0] for face in scene.faces])
    assert ((alone >= 0).sum(0) > 1).any()
    # Whose depths round differently is not equally near.
    depth = torch.stack([seen(replace(scene, faces=face[None])).depth[0] for face in scene.faces])
    assert torch.equal(seen(scene).face_index[0], (depth == depth.amin(0)).int().argmax(0))
    if by.exact:
        assert torch.equal(seen(scene).face_index[0], (alone >= 0).int().argmax(0))


@everywhere
def test_the_nearer_of_two_faces_wins_whatever_their_order(by):
    screen = torch.tensor([[[0.0, 0.0], [0.0, 9.0], [9.0, 0.0]] * 2], dtype=by.dtype)
    depth = torch.tensor([[3.0, 3.0, 3.0, 2.0, 2.0, 2.0]], dtype=by.dtype)
    for faces, nearer in (([[0, 1, 2], [3, 4, 5]], 1), ([[3, 4, 5], [0, 1, 2]], 0)):
        index = rasterize(screen, depth, torch.tensor(faces), (10, 10), by.backend).face_index
        assert set(index.unique().tolist()) == {-1, nearer}


@everywhere
def test_faces_that_pierce_each_other_change_places_along_their_intersection(by):
    screen = torch.tensor([[[0.0, 0.0], [0.0, 19.0], [19.0, 0.0]] * 2], dtype=torch.float64)
    depth = torch.tensor([[1.0, 2.0, 2.0, 2.0, 1.0, 1.0]], dtype=torch.float64)
    scene = Scene(screen, depth, torch.tensor([[0, 1, 2], [3, 4, 5]]), (20, 20)).by(by)
    assert_seen_as_cast(scene)
    assert set(seen(scene).face_index.unique().tolist()) == {-1, 0, 1}


@in_float32
def test_float32_sees_what_float64_sees(by):
    scene = bumpy_sphere((64, 64), frequency=8).scene
    low, high = seen(scene.by(by)), seen(scene.by(TORCH64))
    assert (low.face_index != high.face_index).sum() <= 1
    same = low.face_index == high.face_index
    torch.testing.assert_close(low.depth[same].double(), high.depth[same], rtol=1e-5, atol=0)
