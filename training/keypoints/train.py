"""Train the keypoint network: ``python training/keypoints/train.py POOL.npz OUT SECONDS [NETWORK.pt]``.

With a network it goes on from that one, at a third of the learning rate. The rate falls by the share of the seconds
that is over. Writes ``network.pt``, the mean of the weights over
the last steps, and ``losses.csv`` into OUT. Three losses, after EdgePoint2 (Yao et al. 2025):

- scores: the teacher's distribution in blocks of 8 pixels, and its logits;
- descriptors: the teacher's, reduced to as many channels by their main directions, at every cell;
- matching: cross entropy of finding each point of one crop among all cells of the other, both ways.
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
from torch.nn import functional

sys.path.insert(0, str(Path(__file__).resolve().parent))
from network import CHANNELS, STRIDE, KeypointNetwork

BATCH = 16  # pairs
RATE, WARM_UP = 4e-3, 200  # learning rate and steps until it is reached
TEMPERATURE = 0.07  # of the softmax over cells, on cosines
RADIUS = 6.0  # pixels around the truth in which cells are no mistakes
FLOOR = -14.0  # logit below which scores do not matter
DISTILL = 2.0, 0.4  # weight of the descriptors' distillation at the beginning and at the end
DETECT = 0.5  # weight of the scores
AVERAGE = 0.998  # decay of the mean of the weights
HELD_OUT = 256  # pairs that are only measured


def losses(network: KeypointNetwork, batch: dict[str, Tensor]) -> tuple[Tensor, ...]:
    """Scores, distillation, matching, and the share of points whose best cell lies within `RADIUS`."""
    images = batch["images"].flatten(0, 1)[:, None].float() / 255
    images = images.to(memory_format=torch.channels_last)
    with torch.autocast("cpu", torch.bfloat16):
        maps, scores = network(images)
    maps, scores = maps.float().contiguous(), scores.float()[:, 0]
    teacher = batch["scores"].flatten(0, 1).float().clamp_min(FLOOR)
    blocks, wanted = (x.unfold(1, 8, 8).unfold(2, 8, 8).flatten(3) for x in (scores, teacher))
    # Blocks without a keypoint say little about where one is.
    weight = wanted.amax(3).sigmoid() + 0.02
    detect = functional.kl_div(
        blocks.log_softmax(3), wanted.log_softmax(3), log_target=True, reduction="none"
    )
    detect = (weight * detect.sum(3)).sum() / weight.sum()
    detect = detect + 0.2 * functional.smooth_l1_loss(scores.clamp_min(FLOOR), teacher)
    unit = functional.normalize(maps, dim=1)
    target = functional.normalize(batch["descriptors"].flatten(0, 1).float(), dim=1)
    distill = 1 - (unit * target).sum(1).mean()
    matching, found = _matching(maps.unflatten(0, (-1, 2)), unit.unflatten(0, (-1, 2)), batch["points"])
    return detect, distill, matching, found


def _matching(maps: Tensor, unit: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Cross entropy and share found; ``maps`` and ``unit`` (B, 2, C, h, w), ``points`` (B, 2, N, 2) with nan."""
    height, width = maps.shape[3:]
    known = points[:, 0, :, 0].isfinite()
    points = points.nan_to_num(0.0)
    size = points.new_tensor([width, height]) * STRIDE
    grid = (2 * (points + 0.5) / size - 1).flatten(0, 1)[:, :, None]
    sampled = functional.grid_sample(maps.flatten(0, 1), grid, align_corners=False)[..., 0]
    sampled = functional.normalize(sampled, dim=1).transpose(1, 2).unflatten(0, (-1, 2))
    own = (sampled[:, 0] * sampled[:, 1]).sum(2) / TEMPERATURE
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    cells = STRIDE * torch.stack([columns, rows], -1).flatten(0, 1).float() + (STRIDE - 1) / 2
    values, right = [], []
    for here, there in ((0, 1), (1, 0)):
        similarity = sampled[:, here] @ unit[:, there].flatten(2) / TEMPERATURE
        near = torch.cdist(points[:, there], cells.expand(len(points), -1, -1)) < RADIUS
        others = similarity.masked_fill(near, -math.inf)
        values.append(torch.logaddexp(others.logsumexp(2), own) - own)
        right.append(own > others.amax(2))
    weight = known.float() / known.sum().clamp_min(1)
    share = sum((r * weight).sum() for r in right) / 2
    return sum((v * weight).sum() for v in values) / 2, share.detach()


def train(file: Path, out: Path, seconds: float, initial: Path | None = None) -> None:
    """Train for so many seconds of wall time, from random weights or from those of a file."""
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    pool = {name: torch.from_numpy(values) for name, values in np.load(file).items()}
    count = len(pool["images"]) - HELD_OUT
    assert pool["descriptors"].shape[2] == CHANNELS
    network = KeypointNetwork().to(memory_format=torch.channels_last).train()
    if initial is not None:
        network.load_state_dict(torch.load(initial, weights_only=True))
    highest = RATE if initial is None else RATE / 3
    mean = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(AVERAGE), use_buffers=True
    )
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-4)
    start, step, sums = time.monotonic(), 0, np.zeros(4)
    rows = [("step", "seconds", "detect", "distill", "matching", "found", "held_matching", "held_found")]
    share = 0.0
    while share < 1:
        share = min((time.monotonic() - start) / seconds, 1.0)
        step += 1
        rate = highest * min(step / WARM_UP, 1.0) * max(0.5 * (1 + math.cos(math.pi * share)), 1e-3)
        for group in optimizer.param_groups:
            group["lr"] = rate
        chosen = torch.from_numpy(rng.integers(count, size=BATCH))
        parts = losses(network, {name: values[chosen] for name, values in pool.items()})
        distill = DISTILL[1] + (DISTILL[0] - DISTILL[1]) * (1 - share) * (initial is None)
        optimizer.zero_grad(set_to_none=True)
        (DETECT * parts[0] + distill * parts[1] + parts[2]).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimizer.step()
        mean.update_parameters(network)
        sums += [float(part.detach()) for part in parts]
        if step % 500 == 0 or share == 1:
            mean.eval()
            with torch.no_grad():
                held = losses(mean.module, {name: values[count:] for name, values in pool.items()})
            row = (step, time.monotonic() - start, *(sums / (step % 500 or 500)), *map(float, held[2:]))
            rows.append(tuple(round(value, 4) for value in row))
            print(*rows[-1], flush=True)
            sums[:] = 0
            torch.save(mean.module.state_dict(), out / "network.pt")
            with (out / "losses.csv").open("w", newline="", encoding="utf-8") as stream:
                csv.writer(stream).writerows(rows)


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5):
        raise SystemExit(__doc__)
    train(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), *map(Path, sys.argv[4:]))
