"""Train the segmentation network: ``python training/segmentation/train.py RECIPE.yaml OUT``.

Goes on where OUT has a checkpoint. Writes ``checkpoint.pt``, ``losses.csv`` and ``validation.csv``; ``export.py``
makes the ONNX file. The pool may grow meanwhile.
"""

from __future__ import annotations

import copy
import csv
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from batches import SamplePool, make_batch
from first_weights import load_exported
from network import SegmentationNetwork
from recipe import Recipe, read_recipe
from stepping import Batch, Stepper
from validate import MEASURES, validate

_REPORT_EVERY, _REFRESH_EVERY = 50, 200


def train(recipe: Recipe, out: Path) -> None:
    """Train by a recipe into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(recipe.threads)
    cv2.setNumThreads(1)
    torch.manual_seed(recipe.seed)
    network = SegmentationNetwork()
    held_out = SamplePool(recipe.pool, "validation")
    if recipe.first is not None:
        load_exported(network, recipe.first, SamplePool(recipe.pool, "train"))
    network = network.to(recipe.device).to(memory_format=torch.channels_last).train()
    average = copy.deepcopy(network).eval()
    stepper = Stepper(network, recipe)
    first = _resume(out / "checkpoint.pt", network, average, stepper)
    steps = _Steps(recipe)
    for size_from in recipe.sizes if recipe.replay else ():
        stepper.record(steps[size_from])
    follow = _follower(average, network)
    start, sums = time.monotonic(), torch.zeros(2, device=recipe.device)
    for step, batch in enumerate(_batches(steps, recipe, first), first + 1):
        done = progress(step, time.monotonic() - start, recipe)
        sums += stepper(batch, learning_rate(step, done, recipe))
        follow(min(recipe.average, step / (step + 10)))
        if step % _REPORT_EVERY == 0:
            row = step, time.monotonic() - start, int(batch[3]), *(sums / _REPORT_EVERY).tolist()
            _write_row(out / "losses.csv", ("step", "seconds", "samples", "object", "occluder"), row)
            sums.zero_()
        if step % recipe.validate_every == 0 and len(held_out):
            measured = validate(_on_cpu(average), held_out)
            _write_row(out / "validation.csv", ("step", *MEASURES), (step, *measured))
        if step % recipe.checkpoint_every == 0 or done >= 1:
            _save(out / "checkpoint.pt", network, average, stepper.optimizer, step)
        if done >= 1:
            break


def progress(step: int, seconds: float, recipe: Recipe) -> float:
    """How much of the training is done, 0 to 1: by its steps, or by its time if that is over before."""
    return max(step / recipe.steps, seconds / recipe.seconds if recipe.seconds else 0.0)


def learning_rate(step: int, done: float, recipe: Recipe) -> float:
    """Rising, then constant, then falling to 0 when the training is ``done`` (1)."""
    left = (1 - done) / max(recipe.cool_down, 1e-6)
    return recipe.learning_rate * min(1.0, step / recipe.warm_up, max(left, 0.0))


class _Steps(Dataset):
    """By the number of a step, its inputs, targets, whether the occluder is known, and how large the pool was."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self._pool = SamplePool(recipe.pool, "train")
        self._calls = 0

    def __getitem__(self, step: int) -> Batch:
        self._calls += 1
        if self._calls % _REFRESH_EVERY == 0:
            self._pool.refresh()
        recipe = self._recipe
        size = recipe.sizes[max(start for start in recipe.sizes if start <= step)]
        indices = np.random.default_rng([recipe.seed, 2, step]).integers(0, len(self._pool), recipe.batch)
        draw = recipe.box_only, recipe.keep_colours, recipe.keep_motion
        batch = make_batch(self._pool, indices, draw, size, [recipe.seed, 3, step])
        inputs, targets = (
            torch.from_numpy(values.astype(np.float16)) for values in (batch.inputs, batch.targets)
        )
        return inputs, targets, torch.from_numpy(batch.knows_occluder), len(self._pool)


def _batches(steps: _Steps, recipe: Recipe, first: int) -> Iterator[Batch]:
    return iter(
        DataLoader(
            steps, batch_size=None, sampler=range(first + 1, recipe.steps + 1),
            num_workers=recipe.workers, pin_memory=recipe.device.startswith("cuda"),
            worker_init_fn=lambda _: cv2.setNumThreads(1),
        )
    )  # fmt: skip


def _on_cpu(network: nn.Module) -> nn.Module:
    return copy.deepcopy(network).cpu()


def _follower(average: nn.Module, network: nn.Module) -> Callable[[float], None]:
    """What moves the average towards the network, given the share that stays."""
    pairs = list(zip(average.state_dict().values(), network.state_dict().values(), strict=True))
    means, values = zip(*(pair for pair in pairs if pair[0].dtype.is_floating_point), strict=True)

    def follow(decay: float) -> None:
        with torch.no_grad():
            torch._foreach_lerp_(means, values, 1 - decay)

    return follow


def _resume(file: Path, network: nn.Module, average: nn.Module, stepper: Stepper) -> int:
    if not file.exists():
        return 0
    state = torch.load(file, weights_only=True, map_location="cpu")
    network.load_state_dict(state["network"])
    average.load_state_dict(state["average"])
    stepper.resume(state["optimizer"])
    return state["step"]


def _save(
    file: Path, network: nn.Module, average: nn.Module, optimizer: torch.optim.Optimizer, step: int
) -> None:
    parts = {"network": network, "average": average, "optimizer": optimizer}
    part = file.with_suffix(".part")
    torch.save({name: value.state_dict() for name, value in parts.items()} | {"step": step}, part)
    part.replace(file)


def _write_row(file: Path, columns: tuple[str, ...], values: tuple[float, ...]) -> None:
    new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if new:
            writer.writerow(columns)
        writer.writerow([values[0], *(round(float(value), 4) for value in values[1:])])


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("Usage: python training/segmentation/train.py RECIPE.yaml OUT")
    train(read_recipe(Path(sys.argv[1])), Path(sys.argv[2]))
