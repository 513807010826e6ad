"""Begin with the weights of an exported network, in which every batch normalization is part of its convolution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from batches import Given, SamplePool, box_of, network_input
from network import SIZE
from scene_sequences import PLANES

_SAMPLES = 64


def load_exported(network: nn.Module, file: Path, pool: SamplePool) -> None:
    """Put the weights of an ONNX file into a network that is not folded, and answers as the file does.

    Args:
        network: Has batch normalizations.
        file: What ``export.py`` wrote.
        pool: Samples that the normalizations' means and variances are measured on.
    """
    values = _initializers(file)
    state = network.state_dict()
    norms = {name: module for name, module in network.named_modules() if isinstance(module, nn.BatchNorm2d)}
    for name in state:
        if name in values and name.removesuffix(".weight").removesuffix(".bias") not in norms:
            state[name] = values[name]
    network.load_state_dict(state)
    for name, norm in norms.items():
        nn.init.ones_(norm.weight)
        norm.running_var.fill_(1 - norm.eps)
        norm.running_mean.zero_()
        norm.bias.data.copy_(values[f"{name.rpartition('.')[0]}.0.bias"])
    _normalize(network, norms, _crops(pool))


def _initializers(file: Path) -> dict[str, Tensor]:
    import onnx
    from onnx import numpy_helper

    return {
        tensor.name.removesuffix(".half"): torch.from_numpy(numpy_helper.to_array(tensor).astype(np.float32))
        for tensor in onnx.load(str(file)).graph.initializer
    }


def _crops(pool: SamplePool) -> Tensor:
    """Half of them with all channels, half with the box alone."""
    crops = []
    for index in range(min(len(pool), _SAMPLES)):
        sample, _, _ = pool.sample(index)
        planes = dict(zip(PLANES, sample, strict=True))
        box_only = index % 2 == 0
        box = box_of(planes["object" if box_only else "carried"])
        crops.append(network_input(planes, box, Given(box_only, not box_only, not box_only), SIZE)[0])
    return torch.from_numpy(np.stack(crops))


def _normalize(network: nn.Module, norms: dict[str, nn.BatchNorm2d], crops: Tensor) -> None:
    """Give every normalization the mean and variance of its input, and change its scale and shift accordingly."""
    seen: dict[nn.Module, tuple[Tensor, Tensor]] = {}

    def look(module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        seen[module] = inputs[0].mean((0, 2, 3)), inputs[0].var((0, 2, 3))

    hooks = [norm.register_forward_pre_hook(look) for norm in norms.values()]
    with torch.no_grad():
        network.eval()(crops)
        for norm, (mean, variance) in ((norm, seen[norm]) for norm in norms.values()):
            norm.running_mean.copy_(mean)
            norm.running_var.copy_(variance)
            norm.weight.copy_(torch.sqrt(variance + norm.eps))
            norm.bias.add_(mean)
    for hook in hooks:
        hook.remove()
