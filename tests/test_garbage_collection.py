"""Garbage is left alone while modules are imported, and what is free goes back to the system."""

from __future__ import annotations

import gc
import platform
import subprocess
import sys

import pytest

from tracking3d.runtime.memory import collection_deferred


@pytest.fixture(autouse=True)
def unfrozen():
    yield
    gc.unfreeze()


def test_no_collection_within_and_collection_afterwards():
    with collection_deferred():
        assert not gc.isenabled()
    assert gc.isenabled()


def test_what_is_alive_at_the_end_is_never_looked_at_again():
    before = gc.get_freeze_count()
    with collection_deferred():
        alive = [[] for _ in range(1000)]
    assert gc.get_freeze_count() >= before + len(alive)


def test_collection_that_was_disabled_stays_disabled():
    gc.disable()
    try:
        with collection_deferred():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_an_error_within_enables_collection_again():
    with pytest.raises(ValueError), collection_deferred():
        raise ValueError
    assert gc.isenabled()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries need no help")
def test_free_memory_between_what_is_held_goes_back_to_the_system():
    script = """
import ctypes, numpy
from tracking3d.runtime.memory import release_free_memory, resident_memory
ctypes.CDLL(None).mallopt(-3, 32 << 20)  # as the command line does
arrays = [numpy.ones(100_000) for _ in range(400)]
del arrays[::2]
before = resident_memory()[0]
release_free_memory()
assert resident_memory()[0] < before - 100, (before, resident_memory())
"""
    subprocess.run([sys.executable, "-c", script], check=True)
