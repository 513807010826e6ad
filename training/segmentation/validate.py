"""Held-out samples: intersection over union from the box alone, with a carried mask, and with something in front."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from batches import Given, SamplePool, box_of, jittered, network_input
from loss import intersection_over_union
from network import SIZE
from scene_sequences import PLANES

MEASURES = (
    "still_box", "still_all", "still_carried", "composed_box", "composed_all", "composed_carried",
    "front_box", "front_all", "front_carried", "occluder_box", "occluder_all",
)  # fmt: skip
"""Mean IoU of photographs (still), of scenes with nothing (composed) and with something in front: from the box alone,
with all channels, and of the carried mask itself; and of the occluder."""

_MOST = 400
_BATCH = 16


def validate(network: nn.Module, pool: SamplePool) -> list[float]:
    """`MEASURES` on the first samples of a pool."""
    network.eval()
    rows: dict[str, list[float]] = {name: [] for name in MEASURES}
    for start in range(0, min(len(pool), _MOST), _BATCH):
        chosen = [pool.sample(index) for index in range(start, min(start + _BATCH, len(pool), _MOST))]
        for box_only in (True, False):
            _measure(network, chosen, box_only, start, rows)
    return [float(np.mean(values)) if values else float("nan") for values in rows.values()]


def _measure(
    network: nn.Module,
    chosen: list[tuple[NDArray[np.uint8], str, bool]],
    box_only: bool,
    seed: int,
    rows: dict[str, list[float]],
) -> None:
    inputs, targets = [], []
    rng = np.random.default_rng(seed)
    for sample, _, _ in chosen:
        planes = dict(zip(PLANES, sample, strict=True))
        box = jittered(box_of(planes["object" if box_only else "carried"]), rng)
        given = Given(box_only, not box_only, not box_only)
        crop, _ = network_input(planes, box, given, SIZE)
        truth = {"carried": planes["object"]}, {"carried": planes["occluder"]}
        inputs.append(crop)
        targets.append(
            [network_input(planes | part, box, Given(False, False, False), SIZE)[0][3] for part in truth]
        )
    with torch.no_grad():
        logits = network(torch.from_numpy(np.stack(inputs)))
    truth = torch.from_numpy(np.array(targets))
    found = intersection_over_union(logits[:, 0], truth[:, 0])
    in_front = intersection_over_union(logits[:, 1], truth[:, 1])
    carried = intersection_over_union(torch.from_numpy(np.stack(inputs)[:, 3] - 0.5), truth[:, 0])
    way = "box" if box_only else "all"
    for index, (_, kind, knows) in enumerate(chosen):
        group = "still" if kind == "still" else "composed" if truth[index, 1].max() < 0.5 else "front"
        rows[f"{group}_{way}"].append(float(found[index]))
        if not box_only:
            rows[f"{group}_carried"].append(float(carried[index]))
        if knows and group == "front":
            rows[f"occluder_{way}"].append(float(in_front[index]))
