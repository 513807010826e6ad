"""DIB-R's soft mask and its gradient as its authors define them, in loops over pixels and faces.

Written from the definition, in normalized device coordinates and one number at a time, to share nothing with the
renderer or with the other oracle. The scenes and constants are those that DIB-R's reference is commonly tested with.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from implementations import everywhere
from numpy.typing import NDArray
from scenes import rounded

from tracking3d.rendering import rasterize, soft_silhouette

Array = NDArray[np.float64]
HEIGHT, WIDTH = 35, 31
EPSILON = 1e-7


def soup(
    seed: int, count: int, spread: float, middle: float = 0.0, around: float = 1.1
) -> list[list[list[float]]]:
    rng = np.random.default_rng(seed)
    centres = middle + rng.uniform(-around, around, (count, 1, 2))
    return (centres + spread * rng.standard_normal((count, 3, 2))).tolist()


SCENES = {
    "front, back and beside": [
        [[-0.7, 0.0], [0.0, -0.7], [0.0, 0.7]],
        [[-0.7, 0.0], [0.0, 0.7], [0.0, -0.7]],
        [[0.0, -0.7], [0.0, 0.7], [0.7, 0.0]],
    ],
    "one thrice": [[[-0.7, -0.7], [0.7, -0.7], [-0.7, 0.7]]] * 3,
    "one thrice, from behind": [[[-0.7, -0.7], [-0.7, 0.7], [0.7, -0.7]]] * 3,
    "soup": soup(1, 12, 0.3),
    "small soup": soup(2, 30, 0.05),
    "crowd beside another": soup(3, 30, 0.02, 0.0, 0.02) + soup(4, 10, 0.02, 0.24, 0.02),
}


@dataclass(frozen=True, eq=False)
class Answer:
    """``mask`` and ``hard`` ``(H, W)``, the loss, and its gradient by the corners ``(F, 3, 2)``."""

    mask: Array
    hard: NDArray[np.bool_]
    loss: float
    gradient: Array


def centre(index: int, side: int) -> float:
    return (2 * index + 1 - side) / side


def inside(x: float, y: float, corners: list[list[float]]) -> bool:
    """Whether a triangle of either orientation holds a point."""
    turns = [
        (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    return min(turns) >= 0 or max(turns) <= 0


@functools.cache
def nearest(name: str, face: int, row: int, column: int) -> tuple[float, dict[int, float]]:
    """Squared distance of a pixel to a face's outline, and the shares of the corners in its nearest point.

    That is one corner, or a point of an edge if the perpendicular meets it.
    """
    x, y, corners = centre(column, WIDTH), centre(row, HEIGHT), in_ndc(name)[face]
    found = [((x - cx) ** 2 + (y - cy) ** 2, {k: 1.0}) for k, (cx, cy) in enumerate(corners)]
    for start, end in ((0, 1), (1, 2), (2, 0)):
        (ax, ay), (bx, by) = corners[start], corners[end]
        length2 = (bx - ax) ** 2 + (by - ay) ** 2
        along = (x - ax) * (bx - ax) + (y - ay) * (by - ay)
        if 0 < along < length2:
            share = along / length2
            dx, dy = ax + share * (bx - ax) - x, ay + share * (by - ay) - y
            found.append((dx**2 + dy**2, {start: 1 - share, end: share}))
    return min(found, key=lambda one: one[0])


@functools.cache
def hard_mask(name: str, both_sides: bool) -> NDArray[np.bool_]:
    """``(H, W)``: pixels whose centre lies in a face, in one seen from the front or in any."""
    faces = [face for face in in_ndc(name) if both_sides or in_front(face)]
    columns = [centre(i, WIDTH) for i in range(WIDTH)]
    rows = [centre(j, HEIGHT) for j in range(HEIGHT)]
    return np.array([[any(inside(x, y, face) for face in faces) for x in columns] for y in rows])


@functools.cache
def defined(name: str, both_sides: bool, sigma: float, boxlen: float, knum: int) -> Answer:
    """The mask, DIB-R's loss against a hard mask shifted by five columns, and its gradient."""
    triangles = np.array(in_ndc(name))
    boxes = [(*(face.min(0) - boxlen).tolist(), *(face.max(0) + boxlen).tolist()) for face in triangles]
    hard = hard_mask(name, both_sides)
    mask = hard.astype(np.float64)
    taken: dict[tuple[int, int], list[tuple[int, float, dict[int, float]]]] = {}
    for row, column in np.argwhere(~hard).tolist():
        x, y, pairs = centre(column, WIDTH), centre(row, HEIGHT), []
        for face, (left, top, right, bottom) in enumerate(boxes):
            if len(pairs) < knum and left <= x < right and top <= y < bottom:
                z, shares = nearest(name, face, row, column)
                pairs.append((face, math.exp(-sigma * z), shares))
        mask[row, column] = 1 - math.prod(1 - p for _, p, _ in pairs)
        taken[row, column] = pairs

    loss, by_mask = overlap_loss(mask, target())
    gradient = np.zeros_like(triangles)
    for (row, column), pairs in taken.items():
        place = np.array([centre(column, WIDTH), centre(row, HEIGHT)])
        rest = math.prod(1 - p for _, p, _ in pairs)
        for face, p, shares in pairs:
            by_z = -sigma * by_mask[row, column] * rest / (1 - p + EPSILON) * p
            point = sum(share * triangles[face, corner] for corner, share in shares.items())
            for corner, share in shares.items():
                gradient[face, corner] += by_z * 2 * share * (point - place)
    return Answer(mask, hard, loss, gradient)


def in_front(triangle: list[list[float]]) -> bool:
    (ax, ay), (bx, by), (cx, cy) = triangle
    return (by - ay) * (cx - ax) > (bx - ax) * (cy - ay)  # y points down


def overlap_loss(mask: Array, target: Array) -> tuple[float, Array]:
    """``1 - sum(a b) / (sum(a + b - a b) + 1e-10)``, and its gradient by a."""
    both, either = (mask * target).sum(), (mask + target - mask * target).sum() + 1e-10
    return 1 - both / either, -target / either + both * (1 - target) / either**2


def target() -> Array:
    """A hard mask, shifted by five columns: that of the first scene, for all of them."""
    return np.roll(hard_mask("front, back and beside", True).astype(np.float64), 5, 1)


def in_pixels(name: str) -> torch.Tensor:
    """``(1, 3 F, 2)`` corners in pixels, in numbers that float32 knows."""
    ndc = torch.tensor(SCENES[name], dtype=torch.float64).reshape(1, -1, 2)
    return rounded((ndc + 1) * torch.tensor([WIDTH, HEIGHT]) / 2 - 0.5)


@functools.cache
def in_ndc(name: str) -> list[list[list[float]]]:
    """``(F, 3, 2)`` the same corners again."""
    pixels = in_pixels(name).numpy().reshape(-1, 3, 2)
    return ((2 * pixels + 1) / np.array([WIDTH, HEIGHT]) - 1).tolist()


@everywhere
@pytest.mark.parametrize("knum", [1, 2, 30])
@pytest.mark.parametrize("boxlen", [0.02, 0.2])
@pytest.mark.parametrize("sigma", [7000.0, 70.0])
@pytest.mark.parametrize("both_sides", [False, True], ids=["faces in front cover", "all faces cover"])
@pytest.mark.parametrize("name", SCENES)
def test_mask_loss_and_gradient_are_dib_r_s(name, both_sides, sigma, boxlen, knum, by):
    expected = defined(name, both_sides, sigma, boxlen, knum)
    screen = in_pixels(name).to(by.dtype)
    faces = torch.arange(screen.shape[1]).reshape(-1, 3)
    depth = torch.ones(screen.shape[:2], dtype=by.dtype)
    index = rasterize(screen, depth, faces, (HEIGHT, WIDTH), by.backend).face_index
    if both_sides:
        index = torch.where(torch.tensor(expected.hard), 0, -1)[None]
    assert np.array_equal(index[0] >= 0, expected.hard)
    screen.requires_grad_()
    mask = soft_silhouette(screen, depth, faces, index, sigma, boxlen, knum, by.backend)
    np.testing.assert_allclose(mask[0].detach(), expected.mask, rtol=1e-5, atol=1e-5)

    shifted = torch.tensor(target(), dtype=by.dtype)[None]
    both, either = (mask * shifted).sum((1, 2)), (mask + shifted - mask * shifted).sum((1, 2))
    loss = 1 - (both / (either + 1e-10)).mean()
    loss.backward()
    assert loss.item() == pytest.approx(expected.loss, abs=1e-5)
    by_ndc = screen.grad * torch.tensor([WIDTH, HEIGHT]) / 2
    np.testing.assert_allclose(by_ndc.reshape(-1, 3, 2), expected.gradient, rtol=1e-5, atol=1e-5)


def test_every_cap_leaves_faces_out_in_these_scenes():
    for name, caps in (("soup", (1, 2)), ("small soup", (1, 2)), ("crowd beside another", (1, 2, 30))):
        all_faces = defined(name, False, 70.0, 0.2, 1000)
        for knum in caps:
            assert np.abs(defined(name, False, 70.0, 0.2, knum).mask - all_faces.mask).max() > 0.05


@pytest.mark.parametrize("name", SCENES)
def test_gradients_are_large_enough_to_be_compared(name):
    assert np.abs(defined(name, False, 7000.0, 0.02, 30).gradient).max() > 0.01
