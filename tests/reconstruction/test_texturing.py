"""The texture is what the views show: as fine as they are, and of what most of them say."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import twins.texturing
from rendered_views import FINE, ball, pattern, view

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction import bake_texture, texturing
from tracking3d.reconstruction.meshing import unwrap
from tracking3d.reconstruction.texturing import fill_holes, texture_size
from tracking3d.rendering import TexelMap, sample_texture
from tracking3d.ui.report.run_report import model_data

YAWS = (-40, -20, 0, 20, 40)


def error(model: ObjectModel, truth: np.ndarray) -> float:
    """Mean difference to the pattern, in [0, 1], at texels that are seen well."""
    size = len(model.texture)
    centres = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(centres, centres)
    uv = torch.tensor(np.stack([u, v], -1).reshape(-1, 2), dtype=torch.float32)
    expected = sample_texture(torch.from_numpy(truth).permute(2, 0, 1), uv).reshape(size, size, 3).numpy()
    well = model.texture_weight > np.quantile(model.texture_weight[model.texture_weight > 0], 0.5)
    return float(np.abs(model.texture / 255 - expected)[well].mean())


def test_the_texture_is_as_fine_as_the_views():
    views = [view(n, yaw) for n, yaw in enumerate(YAWS)]
    model = bake_texture(ball(), views)
    assert len(model.texture) == texture_size(views, 2048) == 512
    assert error(model, pattern()) < 0.04
    # What a texture of the size that the solver works with could say at best.
    coarse = pattern().reshape(16, FINE // 16, 16, FINE // 16, 3).mean((1, 3))
    best = np.kron(coarse, np.ones((FINE // 16, FINE // 16, 1)))
    assert error(model, pattern()) < 0.5 * np.abs(best - pattern()).mean()


def test_what_no_view_shows_is_marked_and_continues_what_is_seen():
    model = bake_texture(ball(), [view(0, 0.0)])
    known = model.texture_weight > 0
    assert 0.2 < known.mean() < 0.5
    low, high = model.texture[known].min(0), model.texture[known].max(0)
    assert (model.texture >= low).all() and (model.texture <= high).all()


def unwrapped(yaws: Iterable[float]) -> ObjectModel:
    """The ball with an atlas of charts, seen from these sides."""
    pytest.importorskip("xatlas", reason="xatlas is absent: pip install 'tracking3d[model]'")
    model = ball()
    model = replace(model, face_uvs=unwrap(model.vertices, model.faces))
    return bake_texture(model, [view(n, yaw) for n, yaw in enumerate(yaws)])


def around(texels: np.ndarray) -> np.ndarray:
    """Those texels and their neighbours, diagonal ones too."""
    return cv2.dilate(texels.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def test_what_was_seen_goes_on_beyond_the_edge_of_a_chart_as_colours_do():
    model = unwrapped(YAWS)
    size = len(model.texture)
    charts = np.zeros(size * size, bool)
    charts[TexelMap.of(torch.from_numpy(model.face_uvs).float(), size).texel.numpy()] = True
    charts, seen = charts.reshape(size, size), model.texture_weight > 0
    beside_seen, beside_unseen = around(charts & seen), around(charts & ~seen)
    only_seen, only_unseen = ~charts & beside_seen & ~beside_unseen, ~charts & beside_unseen & ~beside_seen
    assert only_seen.sum() > size and only_unseen.any()
    assert seen[only_seen].all() and not seen[only_unseen].any()


def test_the_picture_for_the_model_viewer_has_no_pale_line_along_charts():
    """There the viewer interpolates between texels on the surface and texels off it."""
    model = unwrapped(range(0, 360, 30))
    belt = (np.abs(model.vertices[model.faces][..., 1]) < 0.6).all(1)
    address = model_data(model)["texture"]
    encoded = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    known = torch.from_numpy(picture[len(picture) // 2 :, :, :1].transpose(2, 0, 1) / 255).float()
    corners = torch.from_numpy(model.face_uvs[belt].reshape(-1, 2)).float()
    assert (sample_texture(known, corners) > 0.65).all()  # from which on the shader shows the colour alone


def test_shape_and_features_stay():
    before = ball()
    after = bake_texture(before, [view(0, 0.0)])
    for name in ("vertices", "faces", "face_uvs", "features"):
        assert getattr(after, name) is getattr(before, name)


def test_one_view_that_shows_something_else_is_outvoted():
    """A hand, a highlight: nearly white, over a third of the ball."""
    views = [view(n, yaw) for n, yaw in enumerate(YAWS)]
    clean = error(bake_texture(ball(), views), pattern())
    image = views[2].image.copy()
    image[: len(image) // 2, len(image) // 3 :] = 250
    alone = error(bake_texture(ball(), [replace(views[2], image=image)]), pattern())
    among = error(bake_texture(ball(), [*views[:2], replace(views[2], image=image), *views[3:]]), pattern())
    assert alone > 0.1
    assert among < clean + 0.2 * (alone - clean)


def test_exposures_are_brought_to_one_level():
    views = [view(n, yaw) for n, yaw in enumerate(YAWS)]
    darker = [
        replace(one, image=(one.image * (0.85 if n % 2 else 1.0)).round().astype(np.uint8))
        for n, one in enumerate(views)
    ]
    level = bake_texture(ball(), darker).texture.astype(float)
    even = bake_texture(ball(), views).texture.astype(float)
    well = bake_texture(ball(), views).texture_weight > 0.3
    ratio = level[well].mean(-1) / even[well].mean(-1)
    assert ratio.std() < 0.03  # 0.075 where each texel has its own view's exposure


def test_the_kernel_adds_up_what_numpy_adds_up(monkeypatch):
    views = [view(n, yaw) for n, yaw in enumerate(YAWS)]
    fast = bake_texture(ball(), views)
    monkeypatch.setattr(texturing, "add_view", twins.texturing.add_view)
    plain = bake_texture(ball(), views)
    assert np.abs(fast.texture.astype(int) - plain.texture).max() <= 1
    assert fast.texture_weight == pytest.approx(plain.texture_weight, rel=1e-4)


def test_the_largest_texture_is_bounded():
    assert len(bake_texture(ball(), [view(0, 0.0)], largest=128).texture) == 128


def test_without_views_or_where_none_shows_it_the_model_is_the_same():
    model = ball()
    assert bake_texture(model, []) is model
    behind = view(0, 0.0)
    T_cam_obj = behind.T_cam_obj.copy()
    T_cam_obj[2, 3] = -5.0
    assert bake_texture(model, [replace(behind, T_cam_obj=T_cam_obj)]) is model


def test_a_uniform_texture_is_continued_as_it_is():
    known = np.zeros((50, 37), bool)
    known[10:12, 5] = True
    texture = np.where(known[..., None], (0.2, 0.5, 0.7), 0.0).astype(np.float32)
    assert fill_holes(texture, known) == pytest.approx(
        np.broadcast_to((0.2, 0.5, 0.7), (50, 37, 3)), abs=1e-5
    )


def test_what_is_continued_goes_around_the_seam_in_u():
    known = np.zeros((64, 64), bool)
    known[:, :8] = known[:, 40:44] = True
    texture = np.zeros((64, 64, 3), np.float32)
    texture[:, :8] = 1.0
    result = fill_holes(texture, known)
    assert result[:, 62].mean() > 0.5 > result[:, 46].mean()  # two texels from white, across the seam
    assert result[known] == pytest.approx(texture[known])


@pytest.mark.parametrize("known", [True, False])
def test_all_or_nothing_known_is_left(known):
    texture = np.random.default_rng(0).random((8, 8, 3)).astype(np.float32)
    assert fill_holes(texture, np.full((8, 8), known)) is texture


def test_details_can_be_left_out():
    views = [view(n, yaw) for n, yaw in enumerate(YAWS)]
    with_details, without = (bake_texture(ball(), views, details=details) for details in (True, False))
    assert error(with_details, pattern()) < error(without, pattern())
