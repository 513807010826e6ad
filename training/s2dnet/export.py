"""Write the trained network as ONNX: ``python training/s2dnet/export.py OUT/checkpoint.pt s2dnet.onnx``."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import nn

from network import CHANNELS, MULTIPLE, STRIDE, DenseFeatures
from tracking3d.features.networks.session import Network


def export(checkpoint: Path, file: Path) -> None:
    """Write the network of a checkpoint, with its batch normalization folded into its convolutions, and compare."""
    network = DenseFeatures()
    network.load_state_dict(torch.load(checkpoint, weights_only=True)["network"])
    network = fold_batch_norms(network.eval())
    example = torch.rand(1, 3, 4 * MULTIPLE, 6 * MULTIPLE)
    sizes = {0: "batch", 2: "height", 3: "width"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter that needs no further package is announced as old
        torch.onnx.export(
            network, (example,), str(file), dynamo=False, opset_version=17,
            input_names=["image"], output_names=["features"], dynamic_axes={"image": sizes, "features": sizes},
        )  # fmt: skip
    image = torch.rand(2, 3, 8 * MULTIPLE, 5 * MULTIPLE)
    with torch.no_grad():
        expected = network(image).numpy()
    answer = Network(file).run({"image": image.numpy()})["features"]
    difference = float(np.abs(answer - expected).max())
    assert answer.shape == (2, CHANNELS, 8 * MULTIPLE // STRIDE, 5 * MULTIPLE // STRIDE)
    assert difference < 1e-4, f"the ONNX file differs by {difference}"
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB, differs from torch by {difference:.1e} at most")


def fold_batch_norms(network: DenseFeatures) -> DenseFeatures:
    """Put every batch normalization into the convolution before it."""
    for block in network.modules():
        if isinstance(block, nn.Sequential) and len(block) == 3 and isinstance(block[1], nn.BatchNorm2d):
            block[0] = nn.utils.fuse_conv_bn_eval(block[0], block[1])
            block[1] = nn.Identity()
    return network


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("Usage: python training/s2dnet/export.py CHECKPOINT.pt FILE.onnx")
    export(Path(sys.argv[1]), Path(sys.argv[2]))
