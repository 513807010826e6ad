"""Pickles of other people: arrays come back as they were, and no file can crash the process or take its memory."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest

from tracking3d_bench.datasets.readers.restricted_pickle import read_pickle

FRAMES = np.arange(24).reshape(2, 3, 4)
ARRAYS = {
    "rows first": FRAMES.astype(np.float32),
    "columns first": np.asfortranarray(FRAMES[0]),
    "axes in another order": FRAMES.transpose(2, 0, 1).astype(np.float16),
    "big endian": FRAMES.astype(">i4"),
    "bool": FRAMES % 5 == 0,
    "texts": np.array(["a", "longer"]),
    "bytes": np.array([b"a", b"longer"]),
    "empty": np.zeros((0, 3)),
    "one number": np.array(7, np.uint8),
}


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_come_back_as_they_were(tmp_path, protocol, name):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([ARRAYS[name]], protocol))
    [array] = read_pickle(tmp_path / "a.pkl")
    assert array.dtype == ARRAYS[name].dtype
    np.testing.assert_array_equal(array, ARRAYS[name])


@pytest.mark.parametrize("protocol", range(6))
def test_plain_values_come_back_as_they_were(tmp_path, protocol):
    shared = [1, 2.5, None, True, "é", b"", b"x", (), (1,), (1, 2, 3, 4), 10**30, {}, {3: [], b"k": "v"}]
    document = {"first": shared, "second": shared, "scalar": np.float64(3)}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(document, protocol))
    read = read_pickle(tmp_path / "a.pkl")
    assert read == document and read["first"] is read["second"] and isinstance(read["scalar"], np.float64)


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def data(value: bytes) -> bytes:
    return b"B" + len(value).to_bytes(4, "little") + value


def named(module: str, name: str) -> bytes:
    return text(module) + text(name) + b"\x93"


def number(value: int) -> bytes:
    return b"\x8a\x08" + value.to_bytes(8, "little", signed=True)


CORE = "numpy._core.multiarray"
NO_FLAGS = b"(K\x03" + text("|") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
OBJECTS = named("numpy", "dtype") + text("O8") + b"\x89\x88\x87R" + NO_FLAGS
"""A type of pointers that says that it is one of plain bytes."""
BYTES_8 = named("numpy", "dtype") + text("f8") + b"\x89\x88\x87R" + NO_FLAGS.replace(text("|"), text("<"))
EMPTY = named(CORE, "_reconstruct") + named("numpy", "ndarray") + b"K\x00\x85" + data(b"b") + b"\x87R"
POINTER = bytes(range(1, 9))


def array(dtype: bytes, shape: bytes, content: bytes) -> bytes:
    return EMPTY + b"(K\x01" + shape + dtype + b"\x89" + data(content) + b"tb"


def fields(inner: bytes) -> bytes:
    """A structured type with one field."""
    state = b"(K\x03" + text("|") + b"N" + text("a") + b"\x85}" + text("a") + inner + b"K\x00\x86s"
    return named("numpy", "dtype") + text("V8") + b"\x89\x88\x87R" + state + b"K\x08K\x01K\x00tb"


CRASHING = {
    "a list of objects out of bytes": named("builtins", "list")
    + array(OBJECTS, b"K\x01\x85", POINTER)
    + b"\x85R",
    "the text of objects out of bytes": named("builtins", "str")
    + array(OBJECTS, b"K\x01\x85", POINTER)
    + b"\x85R",
    "an object out of bytes": named(CORE, "scalar") + OBJECTS + data(POINTER) + b"\x86R",
    "objects in a field": array(fields(OBJECTS), b"K\x01\x85", POINTER),
    "a nested tuple as a key": b"})" + b"\x85" * 300_000 + b"Ns",
    "more than its bytes": array(BYTES_8, number(2**40) + b"\x85", bytes(8)),
    "a product of sides beyond 64 bits": array(BYTES_8, number(2**40) + number(2**40) + b"\x86", bytes(8)),
    "a negative side": array(BYTES_8, number(-1) + b"\x85", bytes(8)),
    "an array that is set again while another one uses it": named("numpy._core.numeric", "_frombuffer")
    + b"(" + array(BYTES_8, b"K\x01\x85", bytes(8)) + b"\x94" + BYTES_8 + b"K\x01\x85" + text("C") + b"tR",
    "a large array without bytes": named(CORE, "_reconstruct") + named("numpy", "ndarray")
    + number(2**33) + b"\x85" + text("f8") + b"\x87R",
    "many bytes of nothing": named("builtins", "bytes") + number(2**33) + b"\x85R",
    "a state of a function": named("_codecs", "encode") + b"N}" + text("__defaults__") + b")s\x86b",
}  # fmt: skip


FAR_AWAY = b"\x80\x04Nr\xff\xff\xff\x7f."
"""None, remembered at a place that would take 32 GB if all places before it existed."""

READER = """
import resource, sys
from pathlib import Path
from tracking3d_bench.datasets.readers.restricted_pickle import read_pickle
from tracking3d.errors import InputError
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**30,) * 2)
for file in sys.argv[1:]:
    try:
        print(file, read_pickle(Path(file)), flush=True)
    except InputError as error:
        print(error, flush=True)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says how much address space is used")
def test_no_pickle_ends_the_process_or_takes_its_memory(tmp_path):
    """In a process of its own, with 1 GB of address space beyond what it needs to start."""
    files = [tmp_path / f"{name.replace(' ', '_')}.pkl" for name in CRASHING]
    for file, code in zip(files, CRASHING.values(), strict=True):
        file.write_bytes(b"\x80\x04" + code + b".")
    (tmp_path / "last.pkl").write_bytes(FAR_AWAY)
    command = [sys.executable, "-c", READER, *files, tmp_path / "last.pkl"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, f"{ended.returncode} after {ended.stdout}{ended.stderr}"
    *sentences, last = ended.stdout.splitlines()
    assert last == f"{tmp_path / 'last.pkl'} None"
    for file, sentence in zip(files, sentences, strict=True):
        assert sentence.startswith(f"{file} cannot be read as a pickle: it ")
        assert sentence.endswith("; use an .npz file.")
