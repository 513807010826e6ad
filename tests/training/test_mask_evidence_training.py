"""The script that fits the evidence of pixels finds known weights, and asks where an outline is in question."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.estimation.segmentation import SOURCES, pixel_features


@pytest.fixture(scope="module")
def script():
    file = Path(__file__).resolve().parents[2] / "training" / "mask_evidence.py"
    spec = importlib.util.spec_from_file_location("mask_evidence_training", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_known_weights_are_found_again(script):
    random = np.random.default_rng(0)
    X, weights = random.normal(size=(20000, 3)), np.array([1.0, 0.0, 2.0])
    inside = random.uniform(size=20000) < 1 / (1 + np.exp(-X @ weights))
    samples = script.Samples(X, inside, np.ones(20000), np.arange(20000) % 4)
    np.testing.assert_allclose(script.fitted(samples), weights, atol=0.1)
    assert script.right_share(samples, weights) > 0.75
    half = samples.of(samples.sequence < 2)
    assert len(half.inside) == 10000


def test_pixels_are_asked_near_either_outline_and_nowhere_else(script):
    rows, columns = np.mgrid[:128, :128]
    masks = [(columns - x) ** 2 + (rows - 64) ** 2 < 30**2 for x in (60, 68)]
    found = pixel_features(np.zeros((128, 128, 3), np.uint8), *masks, 0.5, None)
    assert found.shape[-1] == len(SOURCES)
    chosen = script.sampled(found, 0)
    assert len(chosen) == script.PIXELS
    distance = np.min([np.abs(np.hypot(columns - x, rows - 64) - 30) for x in (60, 68)], 0).ravel()
    assert distance[chosen].max() < 9


def test_folders_without_sequences_are_refused(script, tmp_path):
    with pytest.raises(InputError, match="no sequence"):
        script.main([str(tmp_path), "--out", str(tmp_path / "out")])
