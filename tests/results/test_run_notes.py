"""What is added to ``run.json`` after a run."""

from __future__ import annotations

import json

import pytest

from tracking3d.results import layout
from tracking3d.results.run_notes import timed_pass


def test_passes_after_a_run_add_up_to_its_total(tmp_path):
    path = tmp_path / layout.RUN
    path.write_text(
        json.dumps({"timings": {"seconds_total": 5.0, "passes": {"tracking": 5.0}, "stages": {}}})
    )
    for _ in range(2):
        with timed_pass(tmp_path, "shape"):
            pass
    timings = json.loads(path.read_bytes())["timings"]
    assert list(timings["passes"]) == ["tracking", "shape"] and timings["stages"] == {}
    assert timings["seconds_total"] == pytest.approx(sum(timings["passes"].values()))
    assert timings["seconds_total"] > 5


def test_a_run_that_was_killed_says_nothing_of_times(tmp_path):
    (tmp_path / layout.RUN).write_text("{}")
    with timed_pass(tmp_path, "shape"):
        pass
    assert json.loads((tmp_path / layout.RUN).read_bytes()) == {}
