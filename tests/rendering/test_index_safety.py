"""Indices that name nothing are refused in a sentence: a kernel would read or write anywhere."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scenes import Scene, bumpy_sphere, triangles

from tracking3d.rendering import (
    interpolate,
    pose_normal_equations,
    rasterize,
    render,
    soft_silhouette,
    texture_losses,
)
from tracking3d.rendering.kernels.compilation import check_corners

FAR = [1, 1000, 2**31, 2**62]


@pytest.fixture
def scene() -> Scene:
    return replace(triangles(1, faces=6), backend="numba", screen=triangles(1, faces=6).screen.float())


def float32(scene: Scene) -> Scene:
    return replace(scene, depth=scene.depth.float())


def wrong_corner(faces: torch.Tensor, corner: int) -> torch.Tensor:
    faces = faces.clone()
    faces[3, 1] = corner
    return faces


@pytest.mark.parametrize("corner", [*[17 + far for far in FAR], -1, -1000, -(2**62)])
@pytest.mark.parametrize("what", ["rasterize", "soft_silhouette", "interpolate"])
def test_faces_that_name_vertices_that_do_not_exist_are_refused(what, corner, scene):
    scene = float32(scene)
    index = torch.zeros(2, *scene.size, dtype=torch.long)
    faces = wrong_corner(scene.faces, corner)
    calls = {
        "rasterize": lambda: rasterize(scene.screen, scene.depth, faces, scene.size, "numba"),
        "soft_silhouette": lambda: soft_silhouette(scene.screen, scene.depth, faces, index, backend="numba"),
        "interpolate": lambda: interpolate(
            scene.screen, scene.depth, faces, torch.rand(6, 3, 2), index, "numba"
        ),
    }
    low, high = min(corner, 0), max(corner, 17)
    with pytest.raises(
        IndexError, match=rf"^faces name vertices {low} to {high}, but there are 18 vertices$"
    ):
        calls[what]()


def test_a_mesh_of_which_a_face_names_no_vertex_is_not_rendered():
    scene = bumpy_sphere()
    arguments = scene.arguments(torch.float32)
    faces = wrong_corner(scene.faces, len(scene.vertices))
    with pytest.raises(IndexError, match="faces name vertices 0 to 162, but there are 162 vertices"):
        render(faces=faces, size=scene.size, backend="numba", **arguments)


@pytest.mark.parametrize("face", [5 + far for far in FAR])
def test_pixels_that_name_faces_that_do_not_exist_are_refused(face, scene):
    scene = float32(scene)
    index = torch.full((2, *scene.size), -1)
    index[1, 3, 4] = face
    with pytest.raises(IndexError, match=rf"^face_index names face {face}, but there are 6 faces$"):
        interpolate(scene.screen, scene.depth, scene.faces, torch.rand(6, 3, 2), index, "numba")


def test_pixels_may_not_name_any_face_where_there_are_none(scene):
    scene = float32(scene)
    index = torch.zeros(2, *scene.size, dtype=torch.long)
    with pytest.raises(IndexError, match="face_index names face 0, but there are 0 faces"):
        interpolate(scene.screen, scene.depth, scene.faces[:0], torch.rand(0, 3, 2), index, "numba")


def test_any_negative_face_is_no_face(scene):
    scene = float32(scene)
    index = torch.full((2, *scene.size), -7)
    assert interpolate(scene.screen, scene.depth, scene.faces, torch.rand(6, 3, 2), index, "numba").shape == (
        0,
        2,
    )
    mask = soft_silhouette(scene.screen, scene.depth, scene.faces, index, backend="numba")
    assert mask.isfinite().all()


@pytest.mark.parametrize("pixel", [*[31 + far for far in FAR], -1, -(2**62)])
def test_pixels_out_of_range_are_refused(pixel):
    pixels = torch.tensor([0, 5, pixel, 31])
    low, high = min(pixel, 0), max(pixel, 31)
    with pytest.raises(IndexError, match=rf"^pixels go from {low} to {high}, but there are 32$"):
        texture_losses(
            torch.rand(3, 4, 4), torch.rand(4, 2), torch.rand(2, 3, 4, 4), pixels, 0.5, backend="numba"
        )


def test_frames_without_pixels_have_no_pixel_zero():
    with pytest.raises(IndexError, match="pixels go from 0 to 0, but there are 0"):
        texture_losses(
            torch.rand(3, 4, 4),
            torch.rand(1, 2),
            torch.rand(0, 3, 4, 4),
            torch.zeros(1, dtype=torch.long),
            0.5,
            backend="numba",
        )


def test_as_many_weights_as_covered_pixels_are_wanted():
    scene = bumpy_sphere((20, 20))
    result = render(faces=scene.faces, size=scene.size, backend="numba", **scene.arguments(torch.float32))
    with pytest.raises(ValueError, match=r"weight has shape \(3,\)"):
        pose_normal_equations(
            result, torch.rand(2, 3, 20, 20), scene.t.float(), 0.5, torch.zeros(3), backend="numba"
        )


def test_no_faces_name_no_vertices():
    check_corners(torch.zeros(0, 3, dtype=torch.long), torch.zeros(1, 0, 2))


def test_indices_of_32_bits_are_refused_before_a_kernel_reads_them(scene):
    scene = float32(scene)
    with pytest.raises(TypeError, match="int32"):
        rasterize(scene.screen, scene.depth, scene.faces.int(), scene.size, "numba")
