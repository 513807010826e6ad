"""Train the segmentation network: ``python training/segmentation/train.py RECIPE.yaml OUT``.

Goes on where OUT has a checkpoint. Writes ``checkpoint.pt``, ``losses.csv`` and ``validation.csv``; ``export.py``
makes the ONNX file. The pool may grow meanwhile.
"""

from __future__ import annotations

import copy
import csv
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from batches import Batch, SamplePool, make_batch
from loss import map_loss
from network import SegmentationNetwork
from recipe import Recipe, read_recipe
from validate import MEASURES, validate

_REPORT_EVERY, _REFRESH_EVERY = 50, 200


def train(recipe: Recipe, out: Path) -> None:
    """Train by a recipe into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(recipe.threads)
    cv2.setNumThreads(1)
    torch.manual_seed(recipe.seed)
    network = SegmentationNetwork().to(recipe.device).to(memory_format=torch.channels_last).train()
    average = copy.deepcopy(network).eval()
    optimizer = torch.optim.AdamW(
        network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay
    )
    first = _resume(out / "checkpoint.pt", network, average, optimizer)
    pool, held_out = SamplePool(recipe.pool, "train"), SamplePool(recipe.pool, "validation")
    start, sums = time.monotonic(), np.zeros(2)
    with ThreadPoolExecutor(1) as ahead:
        batch = ahead.submit(_batch, pool, recipe, first + 1)
        for step in range(first + 1, recipe.steps + 1):
            batch, present = _turn(ahead, batch, pool, recipe, step + 1)
            sums += _step(network, optimizer, present, recipe, step)
            _follow(average, network, min(recipe.average, step / (step + 10)))
            if step % _REPORT_EVERY == 0:
                row = step, time.monotonic() - start, len(pool), *(sums / _REPORT_EVERY)
                _write_row(out / "losses.csv", ("step", "seconds", "samples", "object", "occluder"), row)
                sums[:] = 0
            if step % recipe.validate_every == 0 and len(held_out):
                _write_row(out / "validation.csv", ("step", *MEASURES), (step, *validate(average, held_out)))
            if step % recipe.checkpoint_every == 0 or step == recipe.steps:
                _save(out / "checkpoint.pt", network, average, optimizer, step)


def learning_rate(step: int, recipe: Recipe) -> float:
    """Rising, then constant, then falling to 0: a run can be made longer until it falls."""
    left = (recipe.steps - step) / max(recipe.cool_down * recipe.steps, 1)
    return recipe.learning_rate * min(1.0, step / recipe.warm_up, max(left, 0.0))


def _turn(
    ahead: ThreadPoolExecutor, batch: Future[Batch], pool: SamplePool, recipe: Recipe, step: int
) -> tuple[Future[Batch], Batch]:
    """Wait for a batch, and have the next one made."""
    present = batch.result()
    if step % _REFRESH_EVERY == 0:
        pool.refresh()
    return ahead.submit(_batch, pool, recipe, step), present


def _batch(pool: SamplePool, recipe: Recipe, step: int) -> Batch:
    size = recipe.sizes[max(start for start in recipe.sizes if start <= step)]
    indices = np.random.default_rng([recipe.seed, 2, step]).integers(0, len(pool), recipe.batch)
    draw = recipe.box_only, recipe.keep_colours, recipe.keep_motion
    return make_batch(pool, indices, draw, size, [recipe.seed, 3, step])


def _step(
    network: nn.Module, optimizer: torch.optim.Optimizer, batch: Batch, recipe: Recipe, step: int
) -> tuple[float, float]:
    for group in optimizer.param_groups:
        group["lr"] = learning_rate(step, recipe)
    inputs, targets, known = (
        torch.from_numpy(values).to(recipe.device)
        for values in (batch.inputs, batch.targets, batch.knows_occluder)
    )
    with torch.autocast(recipe.device.partition(":")[0], torch.bfloat16):
        logits = network(inputs.to(memory_format=torch.channels_last))
    logits = logits.float()
    object_ = map_loss(logits[:, 0], targets[:, 0], torch.ones_like(known), recipe.overlap_loss)
    # Photographs with the teacher's masks mostly have nothing in front, but nobody looked.
    occluder = map_loss(logits[:, 1], targets[:, 1], known.clamp_min(0.1), recipe.overlap_loss)
    optimizer.zero_grad(set_to_none=True)
    (object_ + recipe.occluder_loss * occluder).backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimizer.step()
    return float(object_.detach()), float(occluder.detach())


def _follow(average: nn.Module, network: nn.Module, decay: float) -> None:
    with torch.no_grad():
        for mean, value in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
            if mean.dtype.is_floating_point:
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)


def _resume(file: Path, network: nn.Module, average: nn.Module, optimizer: torch.optim.Optimizer) -> int:
    if not file.exists():
        return 0
    state = torch.load(file, weights_only=True)
    network.load_state_dict(state["network"])
    average.load_state_dict(state["average"])
    optimizer.load_state_dict(state["optimizer"])
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
