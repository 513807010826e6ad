"""What cases are made from, and the count of them at the end."""

from __future__ import annotations

import warnings

import pytest
from material import Material, make_material


@pytest.fixture(scope="session")
def material(tmp_path_factory) -> Material:
    """The tiny clip and what belongs to it."""
    with warnings.catch_warnings(action="ignore"):
        return make_material(tmp_path_factory.mktemp("material"))


def pytest_terminal_summary(terminalreporter) -> None:
    """Say how many cases ran, and how many of them failed."""
    name = "test_nothing_malformed_ends"
    passed, failed = (
        sum(name in report.nodeid for report in terminalreporter.stats.get(outcome, ()))
        for outcome in ("passed", "failed")
    )
    if passed or failed:
        terminalreporter.write_line(f"fuzz: {passed + failed} cases, {failed} of them failed")
