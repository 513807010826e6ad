"""Result sets survive their file, and a failed sequence spoils no mean."""

from __future__ import annotations

import json

import pytest

from tracking3d.benchmark.results import ResultSet, format_results, read_results, write_results
from tracking3d.errors import InputError

SCORES = {"a": {"iou_mean": 0.5, "frames_lost": 2}, "b": {"iou_mean": 0.7, "frames_lost": None}, "c": None}
RESULTS = ResultSet("mine", "standard", SCORES, {"c": "it crashed"}, {"suite_version": 1, "masks": "truth"})


def test_a_mean_counts_each_sequence_once_where_it_is_known():
    assert RESULTS.mean("iou_mean") == pytest.approx(0.6)
    assert RESULTS.mean("frames_lost") == 2
    assert RESULTS.mean("bop_ar") is None


def test_a_file_gives_back_what_was_written(tmp_path):
    write_results(RESULTS, tmp_path / "new/results.json")
    assert read_results(tmp_path / "new/results.json") == RESULTS
    document = json.loads((tmp_path / "new/results.json").read_text())
    assert document["mean"] == {"iou_mean": pytest.approx(0.6), "frames_lost": 2}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "other"}', '{"format": "tracking3d-results"}'])
def test_another_file_is_refused_by_name(tmp_path, text):
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(InputError, match=r"other\.json is not a result set"):
        read_results(tmp_path / "other.json")


def test_the_table_has_a_line_for_each_sequence_and_the_mean():
    assert format_results(RESULTS).row_count == 4
