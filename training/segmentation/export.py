"""Write the network as ONNX: ``python training/segmentation/export.py OUT/checkpoint.pt segmentation.onnx``.

The running average of the weights is written, as float16; inputs, outputs and all computation are float32. The file is
compared with torch, and timed on one core.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import numpy as np
import torch

from network import CHANNELS, MULTIPLE, OUTPUTS, SIZE, SegmentationNetwork, fold_batch_norms
from tracking3d.features.networks.session import Network

_MAX_DIFFERENCE = 0.05
"""Of a logit, by the rounding of the weights."""


def export(checkpoint: Path, file: Path) -> None:
    """Write the averaged network of a checkpoint, and compare."""
    network = SegmentationNetwork()
    state = torch.load(checkpoint, weights_only=True, map_location="cpu")
    network.load_state_dict(state["average"])
    network = fold_batch_norms(network.eval())
    example = torch.rand(1, len(CHANNELS), 2 * MULTIPLE, 3 * MULTIPLE)
    sizes = {0: "batch", 2: "height", 3: "width"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter that needs no further package is announced as old
        torch.onnx.export(
            network, (example,), str(file), dynamo=False, opset_version=17,
            input_names=["crop"], output_names=["logits"], dynamic_axes={"crop": sizes, "logits": sizes},
        )  # fmt: skip
    _store_as_float16(file)
    crops = torch.rand(2, len(CHANNELS), SIZE, SIZE) - 0.3
    with torch.no_grad():
        expected = network(crops).numpy()
    session = Network(file)
    answer = session.run({"crop": crops.numpy()})["logits"]
    difference = float(np.abs(answer - expected).max())
    assert answer.shape == (2, len(OUTPUTS), SIZE, SIZE)
    assert answer.dtype == np.float32
    assert difference < _MAX_DIFFERENCE * max(1.0, float(np.abs(expected).max())), (
        f"the ONNX file differs by {difference}"
    )
    print(
        f"{file}: step {state['step']}, {file.stat().st_size / 1e6:.2f} MB, "
        f"{sum(value.numel() for value in network.parameters()) / 1e6:.2f} M parameters, "
        f"differs from torch by {difference:.1e} at most, {_milliseconds(session, crops):.1f} ms on one core"
    )


def _store_as_float16(file: Path) -> None:
    """Halve the file: weights become float16, and are cast back when it is loaded."""
    import onnx
    from onnx import numpy_helper

    model = onnx.load(str(file))
    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type != onnx.TensorProto.FLOAT or np.prod(tensor.dims) < 2:
            continue
        name = tensor.name
        half = numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float16), f"{name}.half")
        tensor.CopyFrom(half)
        casts.append(onnx.helper.make_node("Cast", [half.name], [name], to=onnx.TensorProto.FLOAT))
    for cast in reversed(casts):
        model.graph.node.insert(0, cast)
    onnx.checker.check_model(model)
    onnx.save(model, str(file))


def _milliseconds(session: Network, crops: torch.Tensor) -> float:
    """The fastest of many runs: the machine may be busy."""
    times = []
    for _ in range(50):
        start = time.perf_counter()
        session.run({"crop": crops[:1].numpy()})
        times.append(time.perf_counter() - start)
    return 1000 * min(times)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("Usage: python training/segmentation/export.py CHECKPOINT.pt FILE.onnx")
    export(Path(sys.argv[1]), Path(sys.argv[2]))
