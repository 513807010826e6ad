"""A model is judged by pictures of its object that it was not made from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered_views import ball, pattern, pose, seen, view
from test_volume import CAMERA, shape_views

from tracking3d.reconstruction import bake_texture
from tracking3d.reconstruction.views import shape_view
from tracking3d.scene.view import ObjectView
from tracking3d_bench.evaluation import held_out_frames as module
from tracking3d_bench.evaluation.held_out_frames import held_out_scores

pytest.importorskip("skimage", reason="the extra model is not installed")

YAWS, OUT = (0, 15, 30, 45), 20


@pytest.fixture(scope="module")
def out():
    image, mask = seen(pose(OUT), pattern())
    return shape_view(ObjectView.of_frame(0, image, mask, CAMERA, pose(OUT))), view(0, OUT)


def test_the_right_model_predicts_what_a_wrong_one_does_not(out):
    views = [view(n, yaw) for n, yaw in enumerate(YAWS)]
    right = held_out_scores(bake_texture(ball(), views), shape_views(YAWS), [out])
    small = ball()
    small = bake_texture(replace(small, vertices=0.7 * small.vertices), views)
    wrong = held_out_scores(small, shape_views(YAWS), [out])
    assert right.frames == 1 and right.psnr > 22 and right.ssim > 0.8 and right.covered > 0.97
    assert wrong.psnr < right.psnr - 3 and wrong.ssim < right.ssim - 0.1 and wrong.covered < 0.8


def test_what_is_beside_the_mask_is_not_judged(out):
    shape, texture = out
    views = [view(n, yaw) for n, yaw in enumerate(YAWS)]
    model = bake_texture(ball(), views)
    other = texture.image.copy()
    other[texture.interior <= 0] = 255
    elsewhere = held_out_scores(model, shape_views(YAWS), [(shape, replace(texture, image=other))])
    assert elsewhere.psnr == pytest.approx(held_out_scores(model, shape_views(YAWS), [out]).psnr, abs=1e-6)
    assert np.isfinite(elsewhere.ssim)


def test_the_signal_to_noise_ratio_is_that_of_the_pixels_within_the_mask(out, monkeypatch):
    """Of a model out of sight every pixel is predicted as middle grey; of two like pictures the ratio is 60 dB."""
    shape, texture = out
    away = ball()
    away = replace(away, vertices=away.vertices + 100)
    monkeypatch.setattr(module, "refine_views", lambda surface, views: views)
    picture, inside = texture.image / 255.0, texture.interior > 0
    scores = held_out_scores(away, shape_views(YAWS), [out])
    assert scores.covered == 0
    assert scores.psnr == pytest.approx(-10 * np.log10(np.square(picture - 0.5)[inside].mean()), abs=1e-9)

    monkeypatch.setattr(module, "_UNCOVERED", 0.0)
    black = replace(texture, image=np.zeros_like(texture.image))
    assert held_out_scores(away, shape_views(YAWS), [(shape, black)]).psnr == 60
