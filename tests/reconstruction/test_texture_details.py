"""Details that a mean of views has blurred come back; light and foreign things do not come with them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rendered_views import FINE, ball, pattern, view

from tracking3d.reconstruction import texturing
from tracking3d.rendering import TexelMap
from tracking3d.scene.view import ObjectView

YAWS = (-30, -15, 0, 15, 30)
MODEL = ball()
TEXELS = TexelMap.of(torch.from_numpy(MODEL.face_uvs).float(), FINE)
GAINS = [np.ones(3, np.float32)] * len(YAWS)


def restore_details(model, texture, *rest) -> NDArray[np.float32]:
    """With the colours last, as pictures have them."""
    planes = np.ascontiguousarray(texture.transpose(2, 0, 1))
    return texturing.restore_details(model, planes, *rest).transpose(1, 2, 0)


def views(texture: NDArray[np.float32] | None = None) -> list[ObjectView]:
    return [view(index, yaw, texture) for index, yaw in enumerate(YAWS)]


def shown(restored: NDArray[np.float32], start: NDArray[np.float32]) -> NDArray[np.bool_]:
    """``(T, T)`` the texels that have changed: those that the views show."""
    return np.asarray(np.abs(restored - start).max(2) > 1e-4)


def test_a_blurred_texture_gets_its_details_back():
    blurred = cv2.GaussianBlur(pattern(), (0, 0), 2.0)
    restored = restore_details(MODEL, blurred, TEXELS, views(), GAINS)
    changed = shown(restored, blurred)
    assert changed.mean() > 0.2
    before, after = (np.abs(one - pattern())[changed].mean() for one in (blurred, restored))
    assert after < 0.7 * before


def test_light_is_left_where_it_is():
    brighter = [replace(one, image=np.clip(one.image + 25.0, 0, 255).astype(np.uint8)) for one in views()]
    restored = restore_details(MODEL, pattern(), TEXELS, brighter, GAINS)
    inside = shown(restored, pattern())
    assert abs(float((restored - pattern())[inside].mean())) < 0.01


def test_gains_apply_to_the_views():
    half = [replace(one, image=(one.image // 2).astype(np.uint8)) for one in views()]
    doubled = restore_details(MODEL, pattern(), TEXELS, half, [np.full(3, 2, np.float32)] * len(YAWS))
    same = restore_details(MODEL, pattern(), TEXELS, views(), GAINS)
    assert np.abs(doubled - same).mean() < 0.004


def test_something_small_in_front_leaves_hardly_a_trace():
    spoiled = views()
    image = spoiled[2].image.copy()
    middle = len(image) // 2
    image[middle - 3 : middle + 4, middle - 3 : middle + 4] = 255 - image[middle - 3 : middle + 4][:, :7]
    spoiled[2] = replace(spoiled[2], image=image)
    clean, trace = (restore_details(MODEL, pattern(), TEXELS, each, GAINS) for each in (views(), spoiled))
    assert np.abs(trace - clean).max() < 0.1


def test_what_no_view_shows_stays():
    blurred = cv2.GaussianBlur(pattern(), (0, 0), 2.0)
    back = view(0, 180.0)
    front = restore_details(MODEL, blurred, TEXELS, [view(0, 0.0)], GAINS[:1])
    behind = restore_details(MODEL, blurred, TEXELS, [back], GAINS[:1])
    assert not (shown(front, blurred) & shown(behind, blurred)).any()


def test_threads_change_nothing(monkeypatch):
    blurred = cv2.GaussianBlur(pattern(), (0, 0), 2.0)
    found = []
    for threads in (1, 2):
        monkeypatch.setattr(texturing.cv2, "getNumThreads", lambda threads=threads: threads)
        found.append(restore_details(MODEL, blurred.copy(), TEXELS, views(), GAINS))
    np.testing.assert_array_equal(*found)
