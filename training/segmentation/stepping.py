"""One step of the optimizer; on a GPU it may be recorded once and replayed, which leaves more time for batches."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from loss import map_loss
from recipe import Recipe

Batch = tuple[Tensor, Tensor, Tensor, int]
"""Inputs ``(B, 8, S, S)``, targets ``(B, 2, S, S)``, whether the occluder is known, ``(B,)``, and the pool's size."""

_WARM_UP = 3


class Stepper:
    """Takes steps with batches of one or several sizes.

    Args:
        network: On the recipe's device.
        recipe: The training.
    """

    def __init__(self, network: nn.Module, recipe: Recipe) -> None:
        self._network, self._recipe = network, recipe
        self._replays = recipe.replay and recipe.device.startswith("cuda")
        rate = (
            torch.tensor(recipe.learning_rate, device=recipe.device)
            if self._replays
            else recipe.learning_rate
        )
        self.optimizer = torch.optim.AdamW(
            network.parameters(), rate, weight_decay=recipe.weight_decay, fused=True, capturable=self._replays
        )
        self._recorded: dict[int, tuple[torch.cuda.CUDAGraph, tuple[Tensor, ...], Tensor]] = {}

    def resume(self, state: dict) -> None:
        """Go on with the optimizer's state."""
        self.optimizer.load_state_dict(state)
        if self._replays:
            for group in self.optimizer.param_groups:
                group["lr"] = torch.tensor(self._recipe.learning_rate, device=self._recipe.device)

    def record(self, batch: Batch) -> None:
        """Record the step for the size of this batch, if steps are replayed; no weight changes."""
        if not self._replays:
            return
        self._set_rate(0.0)
        static = tuple(values.to(self._recipe.device).float() for values in batch[:3])
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                self._eager(static)
        torch.cuda.current_stream().wait_stream(stream)
        self.optimizer.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            losses = self._eager(static)
        self._recorded[static[0].shape[-1]] = graph, static, losses

    def __call__(self, batch: Batch, rate: float) -> Tensor:
        """``(2,)``: the losses of the object and of the occluder; the caller may not keep the tensor."""
        self._set_rate(rate)
        if batch[0].shape[-1] not in self._recorded:
            return self._eager(
                tuple(values.to(self._recipe.device, non_blocking=True).float() for values in batch[:3])
            )
        graph, static, losses = self._recorded[batch[0].shape[-1]]
        for place, values in zip(static, batch[:3], strict=True):
            place.copy_(values.to(self._recipe.device, non_blocking=True))
        graph.replay()
        return losses

    def _set_rate(self, rate: float) -> None:
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def _eager(self, batch: tuple[Tensor, ...]) -> Tensor:
        inputs, targets, known = batch
        device = self._recipe.device.partition(":")[0]
        with torch.autocast(device, torch.bfloat16, cache_enabled=not self._replays):
            logits = self._network(inputs.to(memory_format=torch.channels_last))
        logits = logits.float()
        overlap = self._recipe.overlap_loss
        object_ = map_loss(logits[:, 0], targets[:, 0], torch.ones_like(known), overlap)
        # Photographs with the teacher's masks mostly have nothing in front, but nobody looked.
        occluder = map_loss(logits[:, 1], targets[:, 1], known.clamp_min(0.1), overlap)
        self.optimizer.zero_grad(set_to_none=True)
        (object_ + self._recipe.occluder_loss * occluder).backward()
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), 1.0)
        self.optimizer.step()
        return torch.stack([object_.detach(), occluder.detach()])
