"""Figures over the frames become paths, and statuses become stretches."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tracking3d.ui.report.curves import HEIGHT, MOST_POINTS, WIDTH, curve, path_of, stretches


def points(path: str) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", path)]


def test_a_curve_goes_from_edge_to_edge_with_its_extremes_at_the_borders():
    drawn = curve("Distance", [3.0, 1.0, 2.0], " m")
    assert points(drawn.path) == [(166.7, 0.0), (500.0, 100.0), (833.3, 50.0)]
    assert (drawn.low, drawn.high) == ("1.00 m", "3.00 m")
    assert drawn.summary == "Distance: from 1.00 m to 3.00 m, 2.00 m at the end"


def test_a_curve_is_broken_where_there_is_no_figure_and_a_lone_one_is_seen():
    path = path_of(np.array([0.0, 1.0, np.nan, 0.5, np.inf, 0.2, 0.4]))
    assert path.count("M") == 3
    assert path.count("h2") == 1  # of the lone one in the middle


def test_what_lies_beyond_given_limits_stays_in_the_picture():
    drawn = curve("Confidence", [-5.0, 0.5, 7.0], "", (0.0, 1.0))
    assert {y for _, y in points(drawn.path)} == {0.0, HEIGHT / 2, HEIGHT}


@pytest.mark.parametrize("values", [[], [np.nan, np.inf]])
def test_without_a_figure_there_is_no_curve(values):
    assert curve("Nothing", values, "") is None


def test_noise_below_the_digits_shown_is_no_mountain():
    drawn = curve("Distance", 2 + 1e-9 * np.random.default_rng(0).normal(size=50), "")
    assert all(abs(y - HEIGHT / 2) < 1 for _, y in points(drawn.path))


def test_a_long_run_has_a_short_path():
    assert len(points(path_of(np.linspace(0, 1, 100_000)))) <= 2 * MOST_POINTS


def test_stretches_part_where_the_status_changes_and_fill_the_width():
    parts = stretches(["tracked", "tracked", "lost", "lost", "lost", "uncertain"])
    assert [part.status for part in parts] == ["tracked", "lost", "uncertain"]
    assert parts[0].x == 0
    assert sum(part.width for part in parts) == pytest.approx(WIDTH)
    assert stretches([]) == []
