from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.points.follow import FEATURES, Evidence, expected_error
from tracking3d_bench.benchmark.point_methods import chained_dense_flow, chained_lucas_kanade
from tracking3d_bench.benchmark.point_runs import (
    LONG,
    METHODS,
    MeasuredRun,
    PointErrors,
    PointRow,
    finished_jobs,
    returns,
)
from tracking3d_bench.benchmark.point_table import format_points, point_report


@pytest.mark.parametrize("method", [chained_lucas_kanade, chained_dense_flow])
def test_methods_without_a_model_follow_a_picture_that_is_pushed(method):
    noise = np.random.default_rng(0).uniform(0, 255, (96, 128)).astype(np.float32)
    picture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    frames = [np.roll(picture, 2 * n, axis=1).astype(np.uint8) for n in range(5)]
    xy = np.array([[60.0, 40.0], [70.5, 52.0]])
    positions, visible = method(frames)(2, xy)
    exact = xy + 2.0 * (np.arange(5)[:, None, None] - 2) * np.array([1, 0])
    assert np.abs(positions - exact).max() < 0.5
    assert visible.all()


def test_a_return_counts_after_a_long_absence_only():
    seen = np.ones((3, 3 * LONG), bool)
    seen[0, 5 : 5 + LONG] = False
    seen[1, 5 : 5 + LONG - 1] = False
    seen[2, :LONG] = False  # not yet seen at all
    back = returns(seen)
    assert back[0].tolist() == [False] * (5 + LONG) + [True] * (2 * LONG - 5)
    assert not back[1:].any()


def test_what_is_known_badly_is_expected_to_be_further_off():
    shape = (2, 3)
    evidence = Evidence(
        variance=np.array([[0.01, 0.5, np.inf], [0.01, 0.5, np.inf]]),
        spread=np.array([0.01, 0.5, 4.0]),
        views=np.array([20, 8, 1]),
        slant=np.array([0.9, 0.4, 0.1]),
        gap=np.array([1, 30]),
    )
    error = expected_error(evidence)
    assert error.shape == shape
    assert (np.diff(error, axis=1) > 0).all()
    assert (error[1] > error[0]).all()


def test_the_table_means_over_sequences_and_leaves_out_what_is_unknown():
    nothing = PointErrors(np.zeros(0), np.zeros(0), np.zeros(0, bool), np.zeros((0, FEATURES)))

    def measured(name: str, delta: float, returned: float | None) -> MeasuredRun:
        rows = {method: PointRow(delta, 0.9, 0.5, returned) for method in METHODS}
        return MeasuredRun(name, "truth", True, rows, 0.95, nothing, 1.0)

    report = point_report([measured("one", 0.8, None), measured("two", 0.6, 0.7)])
    (group,) = report["groups"]
    assert (group["masks"], group["answers"], group["sequences"]) == ("truth", "refined", 2)
    assert group["methods"]["corrected"]["delta"]["mean"] == pytest.approx(0.7)
    assert group["methods"]["corrected"]["returned"] == {"mean": 0.7, "low": None, "high": None}
    assert format_points(report).row_count == len(METHODS)


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(InputError, match="no finished run"):
        finished_jobs(tmp_path)
