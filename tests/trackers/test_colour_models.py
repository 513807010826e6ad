"""Where each colour lay around a pixel: the compiled kernel, its twin of box filters, and counting by hand."""

from __future__ import annotations

import numpy as np
import pytest
import twins.colour_models

from tracking3d.trackers.colour_models import Palette, local_shares


def crops(size, labels=7, seed=0):
    random = np.random.default_rng(seed)
    draw = [random.integers(0, labels, size).astype(np.uint8) for _ in range(2)]
    return *draw, random.uniform(0, 1, size).astype(np.float32)


@pytest.mark.parametrize("radius", [0, 1, 5, 12])
@pytest.mark.parametrize("size", [(30, 41), (13, 13), (64, 20)], ids=str)
def test_the_kernel_agrees_with_its_twin(size, radius):
    labels, last_labels, mask = crops(size)
    expected = twins.colour_models.local_shares(labels, last_labels, mask, radius)
    np.testing.assert_allclose(local_shares(labels, last_labels, mask, radius, 7), expected, atol=1e-6)


def test_shares_are_means_over_the_neighbourhood():
    labels, last_labels, mask = crops((20, 24))
    shares = local_shares(labels, last_labels, mask, 3, 7)
    for row, column in ((3, 3), (10, 12), (16, 20)):
        around = np.s_[row - 3 : row + 4, column - 3 : column + 4]
        alike = last_labels[around] == labels[row, column]
        assert shares[0, row, column] == pytest.approx(np.mean(alike * mask[around]), abs=1e-6)
        assert shares[1, row, column] == pytest.approx(np.mean(alike * (1 - mask[around])), abs=1e-6)


def test_a_colour_that_lay_in_the_mask_alone_speaks_for_the_object():
    colours = np.zeros((40, 40, 3), np.uint8)
    colours[:, 20:] = 200
    mask = np.zeros((40, 40), np.float32)
    mask[:, 20:] = 1
    palette = Palette(colours)
    labels = palette.label(colours)
    ratio = palette.local_log_ratio(labels, labels, mask, 6)
    assert (ratio[:, 22:] > 2).all()
    assert (ratio[:, 15:18] < -1).all()
