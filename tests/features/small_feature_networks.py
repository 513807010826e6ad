"""Feature networks of a few numbers: average colours of blocks, mixed by known weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

onnx = pytest.importorskip("onnx")
numpy_helper = onnx.numpy_helper
helper, TensorProto = onnx.helper, onnx.TensorProto

KINDS = {"float32": TensorProto.FLOAT, "float16": TensorProto.FLOAT16}


def mixing(channels: int) -> np.ndarray:
    """``(channels, 3)`` known weights."""
    return np.random.default_rng(channels).normal(size=(channels, 3)).astype(np.float32)


def write_network(
    file: Path,
    outputs: Mapping[str, tuple[int, int]],
    sides: tuple[int | str, int | str] = ("h", "w"),
    batch: int | str = "b",
    inputs: tuple[str, ...] = ("image",),
    kind: str = "float32",
) -> Path:
    """Write a network that gives for every output its ``(stride, channels)``: block averages times `mixing`."""
    nodes, weights, answers = [], [], []
    for name, (stride, channels) in outputs.items():
        nodes += [
            helper.make_node(
                "AveragePool",
                [inputs[0]],
                [f"{name}_blocks"],
                kernel_shape=[stride] * 2,
                strides=[stride] * 2,
            ),
            helper.make_node("Conv", [f"{name}_blocks", f"{name}_weights"], [name]),
        ]
        values = mixing(channels)[..., None, None].astype(kind)
        weights.append(numpy_helper.from_array(values, f"{name}_weights"))
        answers.append(helper.make_tensor_value_info(name, KINDS[kind], [batch, channels, None, None]))
    taken = [helper.make_tensor_value_info(name, KINDS[kind], [batch, 3, *sides]) for name in inputs]
    return save(file, nodes, taken, answers, weights)


def save(file: Path, nodes: list, inputs: list, outputs: list, weights: list) -> Path:
    """Write a graph."""
    graph = helper.make_graph(nodes, "small", inputs, outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(file))
    return file


def expected(images: Tensor, stride: int, channels: int) -> Tensor:
    """What such a network is to answer."""
    return torch.einsum(
        "oc,bchw->bohw", torch.from_numpy(mixing(channels)), functional.avg_pool2d(images, stride)
    )
