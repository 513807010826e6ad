"""The tables of history/pages/many-videos.md are what the program makes of the numbers beside them."""

from __future__ import annotations

import pytest
from documentation_pages import ROOT, blocks

from fleet_report import compared, markdown
from fleet_simulation import Fleet, Splitting, skewed_lengths

PAGE = ROOT / "history/pages/many-videos.md"


def test_the_costs_are_those_of_the_stated_figures(capsys):
    for block in blocks(PAGE, "python"):
        exec(compile(block, "history/pages/many-videos.md", "exec"), {})
    printed = capsys.readouterr().out.strip()
    assert printed.count("\n") == 5
    assert printed in PAGE.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_schedules_are_those_of_the_simulation():
    work = 15 * skewed_lengths(10_000)
    for workers in (100, 1000):
        table = markdown(compared(work, Fleet(workers), Splitting(15 * 120.0)))
        assert table in PAGE.read_text(encoding="utf-8")
