"""Arrays of ``.npz`` files: what is too large, damaged or no plain type is refused before it is read."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from large_arrays import memory_stays_below, write_zeros

from tracking3d.runtime.array_files import ArrayFile, ArrayFileError, ArrayTooLargeError


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_as_they_were(tmp_path, save):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.eye(3)), "c": np.array("text")}
    save(tmp_path / "a.npz", **arrays)
    with ArrayFile(tmp_path / "a.npz") as file:
        assert file.names == ("a", "b", "c") and file.header("a").nbytes == 48
        for name, array in arrays.items():
            np.testing.assert_array_equal(file.read(name), array)


def test_an_array_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    write_zeros(tmp_path / "a.npz", large=(2**27,))
    told = r"large has 134217728 values, which take 134 MB"
    with ArrayFile(tmp_path / "a.npz") as file, memory_stays_below(2**24):  # noqa: SIM117
        with pytest.raises(ArrayTooLargeError, match=told):
            file.read("large", 2**26)


def test_an_array_that_claims_more_than_the_archive_holds_is_refused(tmp_path):
    header = (
        b"\x93NUMPY\x01\x00\x76\x00"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999,)}".ljust(117)
        + b"\n"
    )
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", header + bytes(80))
    with ArrayFile(tmp_path / "a.npz") as file, pytest.raises(ArrayFileError, match="longer or shorter"):
        file.read("a")


def test_objects_and_absent_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", objects=np.array([{}, None]), fields=np.zeros(3, "f4,f4"))
    with ArrayFile(tmp_path / "a.npz") as file:
        for name in ("objects", "fields", "absent"):
            with pytest.raises(ArrayFileError, match=name):
                file.read(name)


@pytest.mark.parametrize("position", [0, 30, 60, 100, 200, -30])
def test_whatever_is_damaged_is_one_kind_of_error(tmp_path, position):
    np.savez_compressed(tmp_path / "a.npz", a=np.random.default_rng(0).random(50))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    for value in range(0, 256, 5):
        data[position] = value
        (tmp_path / "a.npz").write_bytes(data)
        try:
            with ArrayFile(tmp_path / "a.npz") as file:
                file.read("a")
        except ArrayFileError:
            pass
