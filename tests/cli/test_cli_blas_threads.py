from __future__ import annotations

import os
import sys

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
