"""The scripts of ``benchmarks/``, called as a shell would."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from typer.testing import CliRunner, Result

from script import as_program


@pytest.fixture
def call(tmp_path, monkeypatch):
    """Call the command of a script in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(command: Callable[..., None], *arguments: object) -> Result:
        return CliRunner().invoke(as_program(command), [str(argument) for argument in arguments])

    return call
