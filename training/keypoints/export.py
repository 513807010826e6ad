"""Write the trained network as ONNX: ``python training/keypoints/export.py OUT/network.pt keypoints.onnx``."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import nn

sys.path.insert(0, str(Path(__file__).resolve().parent))
from network import CHANNELS, MULTIPLE, STRIDE, KeypointNetwork
from tracking3d.features.networks.session import Network


def export(weights: Path, file: Path) -> None:
    """Write the network in float32, with its batch normalization folded into its convolutions, and compare."""
    network = KeypointNetwork()
    network.load_state_dict(torch.load(weights, weights_only=True))
    network.eval()
    for block in network.modules():
        if isinstance(block, nn.Sequential) and len(block) > 1 and isinstance(block[1], nn.BatchNorm2d):
            block[0] = nn.utils.fuse_conv_bn_eval(block[0], block[1])
            block[1] = nn.Identity()
    sizes = {2: "height", 3: "width"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter that needs no further package is announced as old
        torch.onnx.export(
            network, (torch.rand(1, 1, 4 * MULTIPLE, 6 * MULTIPLE),), str(file), dynamo=False, opset_version=17,
            input_names=["x"], output_names=["desc", "score"],
            dynamic_axes=dict.fromkeys(("x", "desc", "score"), sizes),
        )  # fmt: skip
    image = torch.rand(1, 1, 8 * MULTIPLE, 5 * MULTIPLE)
    with torch.no_grad():
        expected = [answer.numpy() for answer in network(image)]
    answers = Network(file).run({"x": image.numpy()})
    difference = max(
        float(np.abs(answers[name] - one).max())
        for name, one in zip(("desc", "score"), expected, strict=True)
    )
    assert answers["desc"].shape == (1, CHANNELS, 8 * MULTIPLE // STRIDE, 5 * MULTIPLE // STRIDE)
    assert difference < 1e-3, f"the ONNX file differs by {difference}"
    print(f"{file}: {file.stat().st_size / 1e3:.0f} kB, differs from torch by {difference:.1e} at most")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    export(Path(sys.argv[1]), Path(sys.argv[2]))
