"""The fixed part of the training data: clear crops with the teacher's opinion of them, and rendered objects."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from loss import sample
from pairs import CANVAS, Pair, make_canvas, warped_pair
from photographs import find_cutouts, find_photographs
from recipe import Recipe
from rendered import RenderedObject, render_objects, rendered_pair
from tracking3d.features.networks.session import Network

_TRIES = 4  # points are drawn with a preference for texture: the best of so many


@dataclass(frozen=True, eq=False)
class Pool:
    """What pairs are made from.

    Attributes:
        canvases: ``(M, L, L, 3)`` uint8.
        points: ``(M, N, 2)`` float64, points in the middle of each canvas.
        teacher: ``(M, N, D)`` float16, the teacher's descriptors of them; None without a teacher.
        objects: The rendered objects.
    """

    canvases: NDArray[np.uint8]
    points: NDArray[np.float64]
    teacher: NDArray[np.float16] | None
    objects: list[RenderedObject]


def make_pool(recipe: Recipe) -> Pool:
    """Collect, cut, render and ask the teacher; minutes."""
    start = time.monotonic()

    def tell(text: str) -> None:
        print(f"{time.monotonic() - start:6.0f} s  {text}", flush=True)

    rng = np.random.default_rng([recipe.seed, 1])
    photographs = find_photographs(recipe.photographs, 480, 1600)
    cutouts = find_cutouts(recipe.cutouts, 120, 400)
    tell(f"{len(photographs)} photographs, {len(cutouts)} cutouts")
    side = int(CANVAS * recipe.size)
    canvases = np.stack([make_canvas(photographs, cutouts, side, rng) for _ in range(recipe.crops)])
    border = (side - recipe.size) // 2
    middles = canvases[:, border : border + recipe.size, border : border + recipe.size]
    points = np.stack([_points(middle, recipe.points, rng) for middle in middles])
    tell(f"{len(canvases)} crops")
    objects = render_objects(recipe.objects, recipe.size, photographs)
    tell(f"{len(objects)} objects")
    teacher = _ask_teacher(recipe, middles, points) if recipe.teacher else None
    tell("teacher asked" if recipe.teacher else "no teacher")
    return Pool(canvases, points, teacher, objects)


def _points(image: NDArray[np.uint8], count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """``(count, 2)`` random points, more of them where there is texture."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    texture = cv2.GaussianBlur(np.abs(cv2.Laplacian(grey, cv2.CV_32F)), (0, 0), 3)
    tries = rng.uniform(4, len(image) - 5, (count, _TRIES, 2))
    found = texture[tuple(tries[..., ::-1].astype(int).transpose(2, 0, 1))]
    return tries[np.arange(count), found.argmax(1)]


def _ask_teacher(
    recipe: Recipe, images: NDArray[np.uint8], points: NDArray[np.float64]
) -> NDArray[np.float16]:
    assert recipe.teacher is not None
    network = Network(recipe.teacher, recipe.threads)
    answers = []
    for image, where in zip(images, points, strict=True):
        feed = image.transpose(2, 0, 1)[None].astype(np.float32) / 255
        features = torch.from_numpy(network.run({"image": feed})["desc"][0])
        answers.append(sample(features, torch.tensor(where, dtype=torch.float32), 1.0).half().numpy())
    return np.stack(answers)


def make_batch(pool: Pool, recipe: Recipe, step: int) -> list[Pair]:
    """The pairs of one step; the changes grow over the first tenth of the training."""
    rng = np.random.default_rng([recipe.seed, 2, step])
    strength = min(1.0, 0.3 + 7 * step / recipe.steps)
    batch = []
    for _ in range(recipe.warped_pairs):
        crop = int(rng.integers(len(pool.canvases)))
        batch.append(
            warped_pair(
                pool.canvases[crop], pool.points[crop], crop, recipe.size, rng, strength * rng.uniform(0.4, 1)
            )
        )
    for _ in range(recipe.rendered_pairs):
        item = pool.objects[rng.integers(len(pool.objects))]
        batch.append(rendered_pair(item, recipe.points, rng, strength))
    return batch
