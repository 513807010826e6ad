"""Train the dense feature network: ``python training/s2dnet/train.py RECIPE OUT``; goes on where OUT has a checkpoint.

Writes ``checkpoint.pt`` and ``losses.csv`` into the folder OUT; ``export.py`` makes the ONNX file.
"""

from __future__ import annotations

import csv
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from loss import distillation_loss, matching_loss, sample
from network import STRIDE, DenseFeatures
from pairs import Pair
from pool import Pool, make_batch, make_pool
from recipe import Recipe, read_recipe

COLUMNS = ("step", "seconds", "matching", "found", "distillation")


def train(recipe: Recipe, out: Path) -> None:
    """Train by a recipe into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(recipe.threads)
    torch.manual_seed(recipe.seed)
    network = DenseFeatures().to(recipe.device).to(memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(
        network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step, recipe))
    checkpoint = out / "checkpoint.pt"
    first = 0
    if recipe.initial:
        network.load_state_dict(torch.load(recipe.initial, weights_only=True)["network"])
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        schedule.load_state_dict(state["schedule"])
        first = state["step"]
    pool = make_pool(recipe)
    start = time.monotonic()
    sums = np.zeros(3)
    for step in range(first + 1, recipe.steps + 1):
        values = _losses(network, make_batch(pool, recipe, step), pool, recipe, step)
        loss = values[0] + recipe.distillation * values[2]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        sums += [float(value.detach()) for value in values]
        if step % 50 == 0:
            _write_row(out / "losses.csv", step, time.monotonic() - start, sums / 50)
            sums[:] = 0
        if step % recipe.checkpoint_every == 0 or step == recipe.steps:
            torch.save(
                {
                    "network": network.state_dict(),
                    "optimizer": optimizer.state_dict(),
                    "schedule": schedule.state_dict(),
                    "step": step,
                },
                checkpoint,
            )


def _rate(step: int, recipe: Recipe) -> float:
    if step < recipe.warm_up:
        return (step + 1) / recipe.warm_up
    return 0.5 * (1 + math.cos(math.pi * (step - recipe.warm_up) / max(recipe.steps - recipe.warm_up, 1)))


def _losses(
    network: DenseFeatures, batch: list[Pair], pool: Pool, recipe: Recipe, step: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Matching loss, share of found points and distillation loss, means over the batch and both directions."""
    images = torch.from_numpy(np.stack([image for pair in batch for image in pair.images]))
    images = images.permute(0, 3, 1, 2).to(recipe.device, memory_format=torch.channels_last)
    with torch.autocast(recipe.device.partition(":")[0], torch.bfloat16):
        maps = network(images)
    maps = maps.float()
    rng = np.random.default_rng([recipe.seed, 3, step])
    matching, found, distilled = [], [], []
    for pair, (one, two) in zip(batch, maps.unflatten(0, (-1, 2)), strict=True):
        if len(pair.points[0]) < 16:
            continue
        points = [torch.from_numpy(p).to(maps.device) for p in pair.points]
        descriptors = [sample(one, points[0], STRIDE), sample(two, points[1], STRIDE)]
        for here, there in ((0, 1), (1, 0)):
            offset = int(rng.integers(recipe.candidate_step)), int(rng.integers(recipe.candidate_step))
            loss, share = matching_loss(
                descriptors[here], descriptors[there], (one, two)[there], points[there], STRIDE,
                recipe.candidate_step, offset, recipe.temperature, recipe.radius,
            )  # fmt: skip
            matching.append(loss)
            found.append(share)
        if pair.crop >= 0 and pool.teacher is not None:
            teacher = torch.from_numpy(pool.teacher[pair.crop, pair.order]).float().to(maps.device)
            distilled.append(
                distillation_loss(*descriptors, teacher, recipe.temperature, recipe.teacher_temperature)
            )
    zero = maps.sum() * 0
    return tuple(torch.stack(x).mean() if x else zero for x in (matching, found, distilled))  # type: ignore[return-value]


def _write_row(file: Path, step: int, seconds: float, values: np.ndarray) -> None:
    new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if new:
            writer.writerow(COLUMNS)
        writer.writerow([step, round(seconds, 1), *(round(float(value), 4) for value in values)])


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("Usage: python training/s2dnet/train.py RECIPE.yaml OUT")
    train(read_recipe(Path(sys.argv[1])), Path(sys.argv[2]))
