"""Which face is seen where, against ray casting, and what must never happen at shared edges."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from render_oracle import Picture, cast_rays
from scenes import Scene, bumpy_sphere, triangles
from scipy.ndimage import binary_fill_holes

from tracking3d.rendering import Visibility, rasterize


def seen(scene: Scene) -> Visibility:
    return rasterize(scene.screen, scene.depth, scene.faces, scene.size)


def pictures(scene: Scene) -> list[Picture]:
    faces = scene.faces.numpy()
    return [
        cast_rays(screen.numpy(), depth.numpy(), faces, scene.size)
        for screen, depth in zip(scene.screen, scene.depth, strict=True)
    ]


def assert_seen_as_cast(scene: Scene) -> None:
    visibility, expected = seen(scene), pictures(scene)
    assert np.array_equal(visibility.face_index, np.stack([view.face_index for view in expected]))
    np.testing.assert_allclose(visibility.depth, np.stack([view.depth for view in expected]), rtol=1e-9)


@pytest.mark.parametrize("size", [(24, 24), (13, 31), (33, 10), (1, 1), (1, 40)])
@pytest.mark.parametrize("seed", range(4))
def test_random_triangles_are_seen_where_rays_meet_them(seed, size):
    assert_seen_as_cast(triangles(seed, size))


@pytest.mark.parametrize("spread", [0.01, 0.03, 3.0])
def test_tiny_and_huge_triangles_are_seen_where_rays_meet_them(spread):
    assert_seen_as_cast(triangles(7, faces=60, spread=spread))


@pytest.mark.parametrize("size", [(40, 40), (28, 45)])
def test_a_closed_mesh_is_seen_where_rays_meet_it(size):
    assert_seen_as_cast(bumpy_sphere(size).scene)


def test_a_mesh_that_reaches_out_of_the_picture_is_cut_off():
    scene = bumpy_sphere().scene
    assert_seen_as_cast(Scene(scene.screen + torch.tensor([22.0, -19.0]), scene.depth, scene.faces, (40, 40)))


def test_nothing_is_seen_of_a_mesh_outside_the_picture():
    scene = bumpy_sphere().scene
    visibility = seen(Scene(scene.screen + 500.0, scene.depth, scene.faces, scene.size))
    assert (visibility.face_index == -1).all()
    assert visibility.depth.isposinf().all()


def test_no_faces_at_all_leave_the_picture_empty():
    scene = bumpy_sphere().scene
    assert (seen(Scene(scene.screen, scene.depth, scene.faces[:0], (5, 7))).face_index == -1).all()


@pytest.mark.parametrize("depth", [-2.0, -1e-9, 0.0, 5e-4])
def test_faces_with_a_vertex_behind_the_camera_or_before_the_near_plane_are_left_out(depth):
    scene = triangles(1, views=1)
    scene.depth[0, ::9] = depth  # of every third face
    assert_seen_as_cast(scene)
    assert not np.isin(seen(scene).face_index, np.arange(0, 24, 3)).any()


def test_faces_seen_from_behind_are_left_out():
    scene = triangles(2, views=1)
    front = seen(scene).face_index
    back = seen(Scene(scene.screen, scene.depth, scene.faces.flip(1), scene.size)).face_index
    assert not set(front.unique().tolist()) & set(back[back >= 0].tolist())
    assert (front >= 0).any() and (back >= 0).any()


def test_degenerate_faces_are_never_seen():
    scene = triangles(3, views=1, spread=0.6)
    scene.screen[0, 0:3] = torch.tensor([[2.0, 3.0], [10.0, 3.0], [18.0, 3.0]])  # a line
    scene.screen[0, 3:6] = torch.tensor([12.0, 12.0])  # a point
    faces = scene.faces.clone()
    faces[2] = torch.tensor([6, 6, 8])  # a corner twice
    index = seen(Scene(scene.screen, scene.depth, faces, scene.size)).face_index
    assert not np.isin(index, [0, 1, 2]).any()
    assert (index >= 0).any()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_vertices_that_are_not_finite_spoil_only_their_own_faces(bad):
    scene = triangles(4, views=1, faces=6)
    expected = seen(Scene(scene.screen, scene.depth, scene.faces[1:], scene.size)).face_index
    scene.screen[0, 1] = bad
    index = seen(scene).face_index
    others = torch.where(index > 0, index - 1, -1)
    assert torch.equal(others[index != 0], expected[index != 0])


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("snapped", [False, True], ids=["anywhere", "at pixel centres"])
@pytest.mark.parametrize("seed", range(6))
def test_neighbours_leave_no_crack_between_them(seed, snapped, dtype):
    scene = grid(6, snapped, seed).to(dtype)
    index = seen(scene).face_index
    assert (index >= 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(6))
def test_no_pixel_between_neighbours_is_hit_twice(seed, dtype):
    scene = grid(6, False, seed).to(dtype)
    hits = torch.zeros(31, 31)
    for face in scene.faces:
        hits += seen(Scene(scene.screen, scene.depth, face[None], scene.size)).face_index[0] >= 0
    assert (hits == 1).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_closed_mesh_has_no_holes_from_any_side(dtype):
    mesh = bumpy_sphere((96, 96), views=8, frequency=11).scene.to(dtype)
    snapped = Scene(mesh.screen.round(), mesh.depth, mesh.faces, mesh.size)
    for scene in (mesh, snapped):
        for mask in seen(scene).face_index >= 0:
            assert mask.any()
            assert np.array_equal(mask, binary_fill_holes(mask))


def test_a_pixel_on_a_shared_edge_or_vertex_belongs_to_the_lower_of_equally_near_faces():
    scene = grid(5, True, 0)
    alone = torch.stack(
        [seen(Scene(scene.screen, scene.depth, face[None], scene.size)).face_index[0] for face in scene.faces]
    )
    assert ((alone >= 0).sum(0) > 1).any()
    assert torch.equal(seen(scene).face_index[0], (alone >= 0).int().argmax(0))


def test_the_nearer_of_two_faces_wins_whatever_their_order():
    screen = torch.tensor([[[0.0, 0.0], [0.0, 9.0], [9.0, 0.0]] * 2])
    depth = torch.tensor([[3.0, 3.0, 3.0, 2.0, 2.0, 2.0]])
    for faces, nearer in (([[0, 1, 2], [3, 4, 5]], 1), ([[3, 4, 5], [0, 1, 2]], 0)):
        index = rasterize(screen, depth, torch.tensor(faces), (10, 10)).face_index
        assert set(index.unique().tolist()) == {-1, nearer}


def test_faces_that_pierce_each_other_change_places_along_their_intersection():
    screen = torch.tensor([[[0.0, 0.0], [0.0, 19.0], [19.0, 0.0]] * 2], dtype=torch.float64)
    depth = torch.tensor([[1.0, 2.0, 2.0, 2.0, 1.0, 1.0]], dtype=torch.float64)
    scene = Scene(screen, depth, torch.tensor([[0, 1, 2], [3, 4, 5]]), (20, 20))
    assert_seen_as_cast(scene)
    assert set(seen(scene).face_index.unique().tolist()) == {-1, 0, 1}


def test_float32_sees_what_float64_sees():
    scene = bumpy_sphere((64, 64), frequency=8).scene
    low, high = seen(scene.to(torch.float32)), seen(scene)
    assert (low.face_index != high.face_index).sum() <= 1
    same = low.face_index == high.face_index
    torch.testing.assert_close(low.depth[same].double(), high.depth[same], rtol=1e-5, atol=0)
