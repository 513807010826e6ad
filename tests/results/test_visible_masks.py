"""What is in front of the object: kept beside the initial masks, and taken from the estimated ones at the end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tracking3d.frames import Frame, MaskEstimate
from tracking3d.results import layout
from tracking3d.results.files import read_mask, read_occluder, write_mask, write_visible_masks
from tracking3d.results.run_writer import is_initial_mask, write_initial_mask

MASK = np.zeros((20, 30), bool)
MASK[5:15, 5:20] = True
HAND = np.zeros((20, 30), bool)
HAND[8:12, 15:28] = True


@pytest.fixture
def folder(tmp_path):
    for inner in (layout.MASKS, layout.INITIAL_MASKS):
        (tmp_path / inner).mkdir()
    return tmp_path


def test_mask_and_occluder_come_back(folder):
    write_initial_mask(folder, 3, MASK, HAND)
    np.testing.assert_array_equal(read_mask(layout.initial_mask_path(folder, 3)), MASK)
    np.testing.assert_array_equal(
        read_occluder(folder, 3), HAND & ~MASK
    )  # what is the object is not in front of it
    frame = Frame(3, np.zeros((20, 30, 3), np.uint8))
    assert is_initial_mask(folder, frame, MaskEstimate(MASK.astype(np.float32)))


@pytest.mark.parametrize("occluder", [None, HAND & False])
def test_a_frame_in_which_nothing_is_in_front_has_no_occluder(folder, occluder):
    write_initial_mask(folder, 0, MASK, occluder)
    assert read_occluder(folder, 0) is None
    assert read_occluder(folder, 1) is None


def test_visible_masks_are_the_masks_without_the_occluder(folder):
    write_initial_mask(folder, 0, MASK & ~HAND, HAND)
    write_initial_mask(folder, 1, MASK, None)
    for index in range(2):
        write_mask(layout.mask_path(folder, index), MASK)
    write_visible_masks(folder)
    np.testing.assert_array_equal(read_mask(layout.visible_mask_path(folder, 0)), MASK & ~HAND)
    np.testing.assert_array_equal(read_mask(layout.visible_mask_path(folder, 1)), MASK)


@pytest.mark.parametrize("occluder", [None, HAND & False])
def test_if_nothing_is_ever_in_front_there_are_none(folder, occluder):
    write_initial_mask(folder, 0, MASK, occluder)
    write_mask(layout.mask_path(folder, 0), MASK)
    write_visible_masks(folder)
    assert not (folder / layout.VISIBLE_MASKS).exists()


def test_a_frame_is_handed_to_the_solver_with_its_occluder():
    frame = Frame(3, np.zeros((20, 30, 3), np.uint8))
    estimate = MaskEstimate(MASK.astype(np.float32))
    assert estimate.on(frame) is frame
    assert replace(estimate, occluder=HAND).on(frame).occluder is HAND
