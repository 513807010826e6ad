"""Deep code says which stage it is in, and whoever listens hears it."""

from __future__ import annotations

import threading

import pytest

from tracking3d.runtime.progress import StageProgress, listen_to_progress, report_each, report_progress


def test_a_listener_hears_of_every_stage_and_step_in_order():
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        report_progress("report")
        assert list(report_each("texture", ["a", "b"])) == ["a", "b"]
    assert heard == [
        StageProgress("report", 0, None),
        StageProgress("texture", 0, 2),
        StageProgress("texture", 1, 2),
        StageProgress("texture", 2, 2),
    ]


def test_the_number_of_steps_may_be_unknown_or_given():
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        list(report_each("reading", iter("ab")))
        list(report_each("drawing", iter("a"), 3))
    assert [(one.done, one.total) for one in heard] == [(0, None), (1, None), (2, None), (0, 3), (1, 3)]


def test_a_stage_of_which_no_step_comes_has_begun():
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        assert list(report_each("texture", [])) == []
    assert heard == [StageProgress("texture", 0, 0)]


def test_what_reports_within_a_step_is_a_part_of_the_stage_until_that_ends():
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        for _ in report_each("tracking", "ab"):
            for _ in report_each("refining poses", "c"):
                report_progress("texture")
            break
        report_progress("report")
    assert [(one.name, one.inside) for one in heard] == [
        ("tracking", ""),
        ("refining poses", "tracking"),
        ("texture", "refining poses"),
        ("refining poses", "tracking"),
        ("report", ""),
    ]


def test_only_what_is_counted_is_a_step():
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        assert list(report_each("refining frames", range(6), 2, lambda number: number > 3)) == list(range(6))
    assert [(one.done, one.total) for one in heard] == [(0, 2), (1, 2), (2, 2)]


def test_without_a_listener_and_outside_of_it_nobody_is_called():
    heard: list[StageProgress] = []
    report_progress("before")
    with listen_to_progress(heard.append), listen_to_progress(lambda progress: None):
        report_progress("for the inner listener")
    report_progress("after")
    assert heard == []


def test_a_thread_of_its_own_is_not_heard():
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        thread = threading.Thread(target=report_progress, args=("elsewhere",))
        thread.start()
        thread.join()
    assert heard == []


def test_what_a_listener_raises_ends_the_work():
    def stop(progress: StageProgress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), listen_to_progress(stop):
        report_progress("tracking", 1, 2)
