"""The small networks as files, with their descriptions."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_networks import PROMPTABLE, SALIENCY, decoder, encoder, saliency_network

QUICK_CSRT = {"template_size": 64.0, "use_hog": False, "number_of_scales": 5}
"""Enough for a disc that does not change its size."""


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds saliency.onnx, encoder.onnx, decoder.onnx, saliency.yaml and promptable.yaml."""
    folder = tmp_path_factory.mktemp("networks")
    saliency_network(folder / "saliency.onnx")
    encoder(folder / "encoder.onnx")
    decoder(folder / "decoder.onnx")
    (folder / "saliency.yaml").write_text(SALIENCY, encoding="utf-8")
    (folder / "promptable.yaml").write_text(PROMPTABLE, encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def saliency(folder: Path) -> dict[str, object]:
    """Options of a tracker with the saliency network."""
    return {
        "segmenter": str(folder / "saliency.yaml"),
        "model": str(folder / "saliency.onnx"),
        "csrt": QUICK_CSRT,
    }


@pytest.fixture(scope="session")
def promptable(folder: Path) -> dict[str, object]:
    """Options of a tracker with the promptable network."""
    return {
        "segmenter": str(folder / "promptable.yaml"),
        "encoder": str(folder / "encoder.onnx"),
        "decoder": str(folder / "decoder.onnx"),
        "csrt": QUICK_CSRT,
    }
