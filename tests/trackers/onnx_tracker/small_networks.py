"""Segmentation and box networks of a few numbers, with the signatures of the real ones.

Warm is the object: the logit of a pixel is the difference of red and blue.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
node, value = onnx.helper.make_node, onnx.helper.make_tensor_value_info
FLOAT = onnx.TensorProto.FLOAT
SIDE = 64
"""Side of the inputs; embeddings and low-resolution masks have half of it."""


def save(file: Path, nodes: list, inputs: list, outputs: list, constants: dict[str, np.ndarray]) -> Path:
    """Write a graph; arrays are constants of it."""
    weights = [onnx.numpy_helper.from_array(np.asarray(array), name) for name, array in constants.items()]
    graph = onnx.helper.make_graph(nodes, "small", inputs, outputs, weights)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(file))
    return file


def saliency_network(
    file: Path, gain: float = 8.0, side: int | str = SIDE, activation: str = "Sigmoid"
) -> Path:
    """``[1,3,S,S]`` in [0, 1] to two maps ``[1,1,S,S]``, the second one of no use."""
    constants = {
        "warm": np.float32([gain, 0, -gain]).reshape(1, 3, 1, 1),
        "nothing": np.zeros((1, 3, 1, 1), np.float32),
    }
    nodes = [
        node("Conv", ["picture", "warm"], ["logits"]),
        node(activation, ["logits"], ["salient"]),
        node("Conv", ["picture", "nothing"], ["other"]),
    ]
    outputs = [value(name, FLOAT, [1, 1, side, side]) for name in ("salient", "other")]
    return save(file, nodes, [value("picture", FLOAT, [1, 3, side, side])], outputs, constants)


def encoder(file: Path, output: str = "image_embeddings") -> Path:
    """``[1,3,S,S]`` in 0..255 to logits ``[1,1,S/2,S/2]``."""
    nodes = [
        node("Conv", ["image", "warm"], ["differences"]),
        node("AveragePool", ["differences"], [output], kernel_shape=[2, 2], strides=[2, 2]),
    ]
    return save(
        file,
        nodes,
        [value("image", FLOAT, [1, 3, SIDE, SIDE])],
        [value(output, FLOAT, [1, 1, SIDE // 2, SIDE // 2])],
        {"warm": np.float32([0.04, 0, -0.04]).reshape(1, 3, 1, 1)},
    )


def decoder(file: Path) -> Path:
    """The prompts of Segment Anything to ``[1,1,S/2,S/2]`` logits: the embeddings in the box and up to 4 pixels
    beside it, -10 beyond.

    The previous mask's logits are added, a tenth of them, where ``has_mask_input`` is 1; points are not used.
    """
    half = SIDE // 2
    centres = (np.arange(half, dtype=np.float32) + 0.5) * 2
    constants = {
        "columns": centres.reshape(1, half),
        "rows": centres.reshape(half, 1),
        "slack": np.float32(4),
        "first": np.float32(2),
        "last": np.float32(3),
        "beyond": np.float32(-10),
        "tenth": np.float32(0.1),
        "points_axis": np.int64([1]),
        "label_axis": np.int64([2]),
        "zero": np.int64(0),
        "one": np.int64(1),
    }
    nodes = []
    for corner in ("first", "last"):
        nodes += [
            node("Equal", ["point_labels", corner], [f"is_{corner}"]),
            node("Cast", [f"is_{corner}"], [f"weight_{corner}"], to=FLOAT),
            node("Unsqueeze", [f"weight_{corner}", "label_axis"], [f"weights_{corner}"]),
            node("Mul", ["point_coords", f"weights_{corner}"], [f"chosen_{corner}"]),
            node("ReduceSum", [f"chosen_{corner}", "points_axis"], [f"point_{corner}"], keepdims=0),
        ]
        for axis, index in (("columns", "zero"), ("rows", "one")):
            nodes.append(node("Gather", [f"point_{corner}", index], [f"{corner}_{axis}"], axis=1))
    for axis in ("columns", "rows"):
        nodes += [
            node("Add", [axis, "slack"], [f"{axis}_right"]),
            node("Sub", [axis, "slack"], [f"{axis}_left"]),
            node("GreaterOrEqual", [f"{axis}_right", f"first_{axis}"], [f"after_{axis}"]),
            node("LessOrEqual", [f"{axis}_left", f"last_{axis}"], [f"before_{axis}"]),
            node("And", [f"after_{axis}", f"before_{axis}"], [f"within_{axis}"]),
        ]
    nodes += [
        node("And", ["within_columns", "within_rows"], ["in_box"]),
        node("Mul", ["mask_input", "tenth"], ["hint"]),
        node("Mul", ["hint", "has_mask_input"], ["used_hint"]),
        node("Add", ["image_embeddings", "used_hint"], ["logits"]),
        node("Where", ["in_box", "logits", "beyond"], ["masks"]),
        node("Identity", ["orig_im_size"], ["size_again"]),
    ]
    inputs = [
        value("image_embeddings", FLOAT, [1, 1, half, half]),
        value("point_coords", FLOAT, [1, "n", 2]),
        value("point_labels", FLOAT, [1, "n"]),
        value("mask_input", FLOAT, [1, 1, half, half]),
        value("has_mask_input", FLOAT, [1]),
        value("orig_im_size", FLOAT, [2]),
    ]
    outputs = [value("masks", FLOAT, [1, 1, half, half]), value("size_again", FLOAT, [2])]
    return save(file, nodes, inputs, outputs, constants)


def nano_networks(backbone: Path, head: Path) -> tuple[Path, Path]:
    """NanoTrack's two files with the real sizes; the object stays in the middle and keeps its size.

    Template 127 to ``[1,48,8,8]``, search region 255 to ``[1,48,16,16]``; scores and distances to the four
    sides do not depend on what is seen.
    """
    random = np.random.default_rng(0)
    save(
        backbone,
        [
            node("AveragePool", ["input"], ["blocks"], kernel_shape=[16, 16], strides=[16, 16], ceil_mode=0,
                 pads=[0, 0, 1, 1]),
            node("Conv", ["blocks", "weights"], ["output"]),
        ],
        [value("input", FLOAT, [1, 3, 255, 255])],
        [value("output", FLOAT, [1, 48, 16, 16])],
        {"weights": random.normal(size=(48, 3, 1, 1)).astype(np.float32) / 255},
    )  # fmt: skip
    scores = np.zeros((1, 2, 16, 16), np.float32)
    scores[0, 1] = -8
    scores[0, 1, 7:9, 7:9] = 8
    weak = 1e-6 * random.normal(size=(2, 48, 1, 1)).astype(np.float32)
    sides = np.full((1, 4, 16, 16), 32, np.float32)
    save(
        head,
        [
            node("GlobalAveragePool", ["input1"], ["template"]),
            node("Mul", ["input2", "template"], ["matched"]),
            node("Conv", ["matched", "weak"], ["faint"]),
            node("Add", ["faint", "scores"], ["output1"]),
            node("Concat", ["faint", "faint"], ["faint_again"], axis=1),
            node("Add", ["faint_again", "sides"], ["output2"]),
        ],
        [value("input1", FLOAT, [1, 48, 8, 8]), value("input2", FLOAT, [1, 48, 16, 16])],
        [value("output1", FLOAT, [1, 2, 16, 16]), value("output2", FLOAT, [1, 4, 16, 16])],
        {"scores": scores, "sides": sides, "weak": weak},
    )
    return backbone, head


def nano3_networks(backbone: Path, head: Path) -> tuple[Path, Path]:
    """The two files of NanoTrack 3 with the real sizes: warm cells score high, and the box keeps its size."""
    warm = np.zeros((4, 3, 1, 1), np.float32)
    warm[:] = np.float32([-1, 0, 1]).reshape(1, 3, 1, 1) / 255  # the input is BGR
    save(
        backbone,
        [
            node(
                "AveragePool",
                ["input"],
                ["blocks"],
                kernel_shape=[16, 16],
                strides=[16, 16],
                pads=[0, 0, 1, 1],
            ),
            node("Conv", ["blocks", "warm"], ["output"]),
        ],
        [value("input", FLOAT, [1, 3, 255, 255])],
        [value("output", FLOAT, [1, 4, 16, 16])],
        {"warm": warm},
    )
    gain = np.zeros((2, 4, 1, 1), np.float32)
    gain[1] = 2
    save(
        head,
        [
            node("GlobalAveragePool", ["input1"], ["template"]),
            node("Mul", ["template", "nothing"], ["faint"]),
            node("Add", ["input2", "faint"], ["matched"]),
            node(
                "AveragePool", ["matched"], ["cells"], kernel_shape=[4, 4], strides=[1, 1], pads=[1, 1, 1, 1]
            ),
            node("Conv", ["cells", "gain"], ["logits"]),
            node("Sub", ["logits", "half"], ["output1"]),
            node("Add", ["sides", "zero"], ["output2"]),
        ],
        [value("input1", FLOAT, [1, 4, 8, 8]), value("input2", FLOAT, [1, 4, 16, 16])],
        [value("output1", FLOAT, [1, 2, 15, 15]), value("output2", FLOAT, [1, 4, 15, 15])],
        {
            "nothing": np.float32(0),
            "zero": np.float32(0),
            "gain": gain,
            "half": np.float32([0, 3]).reshape(1, 2, 1, 1),
            "sides": np.full((1, 4, 15, 15), 63.5 / 2, np.float32),
        },
    )
    return backbone, head


SALIENCY = """kind: saliency
input: {size: 64}
"""

PROMPTABLE = """kind: promptable
input: {size: 64, fit: pad, divisor: 1}
decoder: {grid: input}
"""
