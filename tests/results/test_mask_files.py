"""Masks are read from files once, and again when these change."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.results import files
from tracking3d.results.files import OCCLUDER, read_mask, read_packed_mask, unpack, write_image, write_mask


def mask(seed: int, shape=(37, 53)) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < 0.4


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (37, 53), (64, 64)])
def test_a_mask_comes_back_as_it_was_written(tmp_path, shape):
    write_mask(tmp_path / "0.png", mask(0, shape))
    for _ in range(2):
        found = read_mask(tmp_path / "0.png")
        assert found.dtype == bool
        np.testing.assert_array_equal(found, mask(0, shape))


def test_what_was_read_may_be_changed(tmp_path):
    write_mask(tmp_path / "0.png", mask(0))
    read_mask(tmp_path / "0.png")[:] = False
    np.testing.assert_array_equal(read_mask(tmp_path / "0.png"), mask(0))


def test_a_file_is_decoded_once(tmp_path, monkeypatch):
    write_mask(tmp_path / "0.png", mask(0))
    decoded = []
    monkeypatch.setattr(files, "decode_grey", lambda data: decoded.append(data) or np.zeros((2, 2), np.uint8))
    for _ in range(3):
        read_mask(tmp_path / "0.png")
    assert len(decoded) == 1


def test_a_file_that_was_written_again_is_read_again(tmp_path):
    for seed in range(20):
        write_mask(tmp_path / "0.png", mask(seed))
        np.testing.assert_array_equal(read_mask(tmp_path / "0.png"), mask(seed))


def test_levels_are_the_object_and_what_is_in_front_of_it(tmp_path):
    levels = np.array([[0, OCCLUDER, 127], [128, 255, OCCLUDER]], np.uint8)
    write_image(tmp_path / "0.png", levels)
    kept = read_packed_mask(tmp_path / "0.png")
    np.testing.assert_array_equal(unpack(kept.mask, kept.shape), levels >= 128)
    np.testing.assert_array_equal(unpack(kept.occluder, kept.shape), levels == OCCLUDER)
    write_mask(tmp_path / "1.png", mask(0))
    assert read_packed_mask(tmp_path / "1.png").occluder is None


def test_no_image_is_none(tmp_path):
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    for name in ("missing.png", "empty.png", "folder.png"):
        assert read_mask(tmp_path / name) is None
