"""Prepare samples: ``python training/segmentation/pool.py RECIPE.yaml [validation | N/M]``.

Goes on where it was stopped. With ``0/2`` and ``1/2`` two processes share the work.

A file ``train_0007.npy`` is ``(N, 8, CANVAS, CANVAS)`` uint8 (`scenes.PLANES`); ``train_0007.csv`` says of which kind
each sample is and whether its occluder is known. Masks that the teacher has not made yet go into later files.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from composed import Material, composed_scene
from cutouts import Masked, cut_out, read_masked, touched_sides, with_hands
from recipe import Recipe, read_recipe
from scene_sequences import CANVAS, PLANES, sample_of, still_scene
from split import held_out

CUTOUT = 150
_READ = 160
"""Photographs with masks that are read for one file of the pool: a random part, for the memory's sake."""

_FIRST, _EACH, _ALL, _PAUSE = 100, 10, 0.9, 30
_BEST, _BEST_TOUCHING = 0.9, 0.96
_MIN_VISIBLE = 0.3
_SHARE_OF_ONE_SOURCE = 0.45


def main(recipe: Recipe, validation: bool, part: int, parts: int) -> None:
    """Make what is missing of the pool, or one of some parts of it."""
    recipe.pool.mkdir(parents=True, exist_ok=True)
    name, count = ("validation", 2) if validation else ("train", recipe.shards)
    for number in range(part, count, parts):
        target = recipe.pool / f"{name}_{number:04d}.npy"
        if target.exists():
            continue
        while not validation and len(list(recipe.masks.glob("*/*.npz"))) < _needed(recipe, number):
            time.sleep(_PAUSE)  # the teacher is still at work
        start = time.monotonic()
        rng = np.random.default_rng([recipe.seed, int(validation), number])
        items, material = _materials(recipe, validation, rng)
        samples, about = [], []
        while len(samples) < recipe.shard:
            sample, row = _make(items, material, recipe, rng)
            if sample is not None:
                samples.append(sample)
                about.append(row)
        with target.with_suffix(".csv").open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream).writerows([("kind", "knows_occluder"), *about])
        part = target.with_suffix(".part.npy")
        np.save(part, np.stack(samples))
        part.replace(target)
        print(f"{target.name}: {len(items)} masks, {time.monotonic() - start:.0f} s", flush=True)


def _needed(recipe: Recipe, number: int) -> int:
    """How many photographs need to have masks before a file of the pool is made."""
    every = sum(1 for _ in recipe.photos.glob("*/*.jpg"))
    return min(_FIRST + _EACH * number, int(_ALL * every))


def _make(
    items: Sequence[Masked], material: Material, recipe: Recipe, rng: np.random.Generator
) -> tuple[NDArray[np.uint8] | None, tuple[str, int]]:
    if rng.random() < recipe.stills:
        scene = still_scene(items[int(rng.integers(len(items)))], rng)
    else:
        scene = composed_scene(material, rng)
    row = scene.kind, int(scene.knows_occluder)
    areas = [np.count_nonzero(frame.object > 0.5) for frame in (scene.first, scene.last, scene.present)]
    if min(areas) < 300 or areas[2] < _MIN_VISIBLE * max(areas):
        return None, row
    sample = sample_of(scene, rng)
    assert sample.shape == (len(PLANES), CANVAS, CANVAS)
    return sample, row


def _materials(recipe: Recipe, validation: bool, rng: np.random.Generator) -> tuple[list[Masked], Material]:
    kept = held_out(recipe.photos)
    files = [file for file in sorted(recipe.masks.glob("*/*.npz")) if not file.name.endswith(".part.npz")]
    files = [file for file in files if (f"{file.parent.name}/{file.stem}.jpg" in kept) == validation]
    chosen = _mixed(files, rng)
    items = [item for file in chosen for item in _items(recipe, file)]
    # What reaches from one side of the picture to the other is rarely an object that someone would box.
    stills = [
        item
        for item in items
        if touched_sides(item) == 0 or (touched_sides(item) == 1 and item.quality > _BEST_TOUCHING)
    ]
    objects = [cut_out(item, CUTOUT) for item in items if touched_sides(item) == 0 and item.quality > _BEST]
    photographs = [
        cv2.imread(str(recipe.photos / f"{f.parent.name}/{f.stem}.jpg")) for f in _mixed(files, rng)[:60]
    ]
    others = sorted(set(recipe.photos.glob("*/*.jpg")) - {recipe.photos / key for key in kept})
    scenery = [file for file in others if not (recipe.masks / file.parent.name / f"{file.stem}.npz").exists()]
    if not validation:
        photographs += [cv2.imread(str(file)) for file in rng.permutation(scenery)[:80]]
    photographs = [cv2.cvtColor(image, cv2.COLOR_BGR2RGB) for image in photographs]
    hands = _hands(recipe, validation, rng)
    return stills, Material(photographs, objects, hands)


def _items(recipe: Recipe, file: Path) -> list[Masked]:
    items = read_masked(recipe.photos, file)
    if recipe.hand_masks is None:
        return items
    hands = recipe.hand_masks / file.parent.name / file.name
    return with_hands(items, read_masked(recipe.photos, hands) if hands.exists() else [])


def _mixed(files: Sequence[Path], rng: np.random.Generator) -> list[Path]:
    """A random part of the files in which no source is more than nearly half."""
    chosen: list[Path] = []
    counts: dict[str, int] = {}
    for index in rng.permutation(len(files)):
        file = files[index]
        if counts.get(file.parent.name, 0) < _SHARE_OF_ONE_SOURCE * _READ:
            counts[file.parent.name] = counts.get(file.parent.name, 0) + 1
            chosen.append(file)
        if len(chosen) == _READ:
            break
    return chosen


def _hands(recipe: Recipe, validation: bool, rng: np.random.Generator) -> list[NDArray[np.uint8]]:
    if recipe.hands is None:
        return []
    files = sorted(recipe.hands.glob("*.png"))
    files = [file for file in files if (int(file.stem.split("_")[0], 16) % 16 == 0) == validation]
    chosen = [files[index] for index in rng.permutation(len(files))[:150]]
    return [cv2.cvtColor(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA) for file in chosen]


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        raise SystemExit("Usage: python training/segmentation/pool.py RECIPE.yaml [validation | N/M]")
    what = (sys.argv[2:] or ["0/1"])[0]
    part, parts = (0, 1) if what == "validation" else map(int, what.split("/"))
    main(read_recipe(Path(sys.argv[1])), what == "validation", part, parts)
