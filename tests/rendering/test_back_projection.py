"""Texture in closed form: what is painted on and rendered comes back by looking."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import bumpy_sphere, waves

from tracking3d.rendering import BackProjection, TexelMap, back_project, render, sample_texture, seen_texels


def looked_at(texture: torch.Tensor, valid: torch.Tensor | None = None) -> tuple[BackProjection, TexelMap]:
    """What three views of the bumpy sphere, painted with ``texture``, show of it."""
    scene = bumpy_sphere((96, 96), views=3, frequency=8)
    texels = TexelMap.of(scene.face_uvs, 32)
    images = render(
        scene.vertices, scene.faces, scene.face_uvs, texture, scene.R, scene.t, scene.K, scene.size
    )
    believed = (images.face_index >= 0).double() if valid is None else valid.expand(3, 96, 96)
    parts = [
        back_project(image, mask, scene.vertices, scene.faces, texels, R, t, K)
        for image, mask, R, t, K in zip(images.image(), believed, scene.R, scene.t, scene.K, strict=True)
    ]
    return parts[0] + parts[1] + parts[2], texels


def test_every_texel_of_the_map_lies_where_its_face_says():
    scene = bumpy_sphere()
    texels = TexelMap.of(scene.face_uvs, 32)
    assert len(texels.texel.unique()) == len(texels.texel) > 0.9 * 32 * 32
    uv = (scene.face_uvs[texels.face] * texels.barycentric[..., None]).sum(1)
    centres = torch.stack([texels.texel % 32 + 0.5, texels.texel // 32 + 0.5], 1) / 32
    off = (uv - centres + torch.tensor([0.5, 0.0])).remainder(1.0) - torch.tensor([0.5, 0.0])
    assert off.abs().min(1).values.max() < 1e-9
    assert (texels.barycentric >= -1e-9).all()


def test_a_painted_surface_is_read_off_its_pictures():
    painted = waves(32)
    seen, _ = looked_at(painted)
    known = seen.weight > 0.05
    assert known.double().mean() > 0.5
    assert (seen.mean() - painted)[:, known].abs().mean() < 0.02


def test_one_colour_comes_back_exactly_and_unseen_texels_stay_zero():
    seen, _ = looked_at(torch.full((3, 8, 8), 0.7, dtype=torch.float64))
    inner = seen.weight > 0.5
    assert seen.mean()[:, inner].min() == pytest.approx(0.7, abs=0.03)
    assert (seen.weight == 0).any()
    assert (seen.mean()[:, seen.weight == 0] == 0).all()


def test_pixels_that_are_not_believed_say_nothing():
    seen, _ = looked_at(waves(8), valid=torch.zeros(1, 96, 96, dtype=torch.float64))
    assert (seen.weight == 0).all() and (seen.total == 0).all()


def test_the_far_side_is_not_painted_through():
    scene = bumpy_sphere((96, 96), views=1, frequency=8)
    texels = TexelMap.of(scene.face_uvs, 32)
    ones = torch.ones(1, 96, 96, dtype=torch.float64)
    seen = back_project(
        ones, ones[0], scene.vertices, scene.faces, texels, scene.R[0], scene.t[0], scene.K[0]
    )
    point = (scene.vertices[scene.faces[texels.face]] * texels.barycentric[..., None]).sum(1) @ scene.R[0].T
    far = texels.texel[point[:, 2] > 0.25]
    assert (seen.weight.flatten()[far] == 0).all()
    assert (seen.weight > 0).double().mean() > 0.25
    picked = sample_texture(seen.weight[None], torch.tensor([[0.5, 0.5]], dtype=torch.float64))
    assert picked.isfinite().all()


def test_the_kernel_sees_what_torch_sees():
    scene = bumpy_sphere((96, 96), views=3, frequency=8)
    vertices, uvs, R, t, K = (
        one.float() for one in (scene.vertices, scene.face_uvs, scene.R, scene.t, scene.K)
    )
    K[:, 0, 2] += 30  # a part lies beyond the frame
    texels = TexelMap.of(uvs, 64)
    image = torch.rand(5, 96, 96)
    valid = (torch.rand(96, 96) - 0.3).clamp(0, 1)
    K = (
        K + torch.tensor([0.0, 0.0, 30.0])[:, None].T * torch.eye(3)[0][:, None]
    )  # a part lies beyond the frame
    for n in range(3):
        fast, plain = (
            seen_texels(image, valid, vertices, scene.faces, texels, R[n], t[n], K[n], backend)
            for backend in ("numba", "torch")
        )
        both, ours, theirs = (
            torch.from_numpy(one)
            for one in np.intersect1d(fast.texel, plain.texel, assume_unique=True, return_indices=True)
        )
        assert len(both) > 300 and len(both) >= 0.999 * max(len(fast.texel), len(plain.texel))
        torch.testing.assert_close(fast.values[:, ours], plain.values[:, theirs], atol=1e-3, rtol=0)
        torch.testing.assert_close(fast.weight[ours], plain.weight[theirs], atol=1e-3, rtol=0)
