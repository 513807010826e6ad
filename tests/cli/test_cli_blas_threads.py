from __future__ import annotations

import ctypes
import os
import sys
from types import SimpleNamespace

import pytest

from tracking3d.cli import main


@pytest.mark.parametrize(("given", "kept"), [(None, "1"), ("3", "3")])
def test_the_command_line_gives_linear_algebra_one_thread_unless_the_user_has_said_otherwise(
    monkeypatch, capsys, given, kept
):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "0")  # so that it is put back afterwards
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    else:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    monkeypatch.setattr(sys, "argv", ["tracking3d", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert os.environ["OPENBLAS_NUM_THREADS"] == kept
    assert "tracking3d" in capsys.readouterr().out


@pytest.mark.parametrize(("given", "options"), [(None, {-8: 2, -3: 32 << 20, -1: 32 << 20}), ("4", {})])
def test_threads_share_two_heaps_unless_the_user_has_said_otherwise(monkeypatch, given, options):
    monkeypatch.delenv("MALLOC_ARENA_MAX", raising=False)
    if given is not None:
        monkeypatch.setenv("MALLOC_ARENA_MAX", given)
    asked = {}
    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(mallopt=asked.__setitem__))
    monkeypatch.setattr(sys, "argv", ["tracking3d", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert asked == options


def test_a_c_library_without_such_heaps_is_left_alone(monkeypatch):
    monkeypatch.delenv("MALLOC_ARENA_MAX", raising=False)
    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace())
    monkeypatch.setattr(sys, "argv", ["tracking3d", "--version"])
    with pytest.raises(SystemExit):
        main()
