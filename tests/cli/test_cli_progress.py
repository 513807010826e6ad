"""What a command shows of its progress where nobody watches a terminal, and what it says of the remaining time."""

from __future__ import annotations

import io
import time

import pytest
from rich.console import Console

from tracking3d.cli import progress as module
from tracking3d.cli.progress import PlannedStage, RemainingTime, estimate_in_words, plan_run, show_progress
from tracking3d.config.loading import load_config
from tracking3d.frames import SkippedFrame
from tracking3d.runtime.progress import StageProgress, listen_to_progress, report_each, report_progress


def wait_for_line(capsys, at_most: float = 20.0) -> str:
    """What is printed next on the standard error, by whatever thread."""
    end = time.monotonic() + at_most
    while time.monotonic() < end:
        if text := capsys.readouterr().err:
            return text.splitlines()[0]
        time.sleep(0.01)
    raise AssertionError(f"nothing was printed in {at_most} s")


def test_a_log_names_the_stage_its_count_and_the_latest_frame(monkeypatch, capsys):
    monkeypatch.setattr(module, "_EVERY", 0.05)
    with show_progress(quiet=False) as display:
        display.show_frame(SkippedFrame(4, "torn"))
        report_progress("tracking", 5, 40)
        display.show_frame(SkippedFrame(4, "torn"))
        while not (line := wait_for_line(capsys)).startswith("tracking"):
            pass
    assert line.startswith("tracking 5/40, frame 4 skipped, ")


def test_a_log_goes_on_within_a_step_that_takes_long(monkeypatch, capsys):
    monkeypatch.setattr(module, "_EVERY", 0.05)
    with show_progress(quiet=False):
        report_progress("report")
        for _ in range(3):  # nothing is reported meanwhile
            assert wait_for_line(capsys).startswith(("report, ", "starting, "))


def test_quiet_is_quiet(monkeypatch, capsys):
    monkeypatch.setattr(module, "_EVERY", 0.01)
    with show_progress(quiet=True) as display:
        report_progress("tracking", 5, 40)
        display.show_frame(SkippedFrame(4, "torn"))
        time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_a_short_command_prints_nothing_in_a_log(capsys):
    with show_progress(quiet=False):
        report_progress("tracking", 5, 40)
    assert capsys.readouterr().err == ""


def after(
    plan: list[PlannedStage], reports: list[tuple[float, str, int, int | None]], now: float
) -> float | None:
    """The remaining time that is estimated ``now``, after some reports at their times."""
    remaining = RemainingTime(plan)
    for at, *progress in reports:
        remaining.take(StageProgress(*progress), at)
    return remaining.seconds(now)


PLAN = [PlannedStage("tracking", 40.0), PlannedStage("refining poses", 20.0), PlannedStage("report", 10.0)]


def test_the_rest_of_the_plan_is_part_of_the_estimate():
    halfway = [(0.4 * done, "tracking", done, 100) for done in range(51)]
    assert after(PLAN, halfway, 20.0) == pytest.approx(50, rel=0.01)


def test_later_stages_are_as_slow_as_earlier_ones_were():
    slowly = [(4.0 * done, "tracking", done, 100) for done in range(101)]
    left = after(PLAN, [*slowly, (400.0, "refining poses", 0, 4)], 400.0)
    assert left == pytest.approx(300, rel=0.1)


def test_the_estimate_is_never_zero_while_there_is_work():
    finished = [(0.4 * done, "tracking", done, 100) for done in range(101)]
    in_report = [*finished, (40.0, "refining poses", 4, 4), (60.0, "report", 0, None)]
    for late in (60.0, 71.0, 500.0):
        assert after(PLAN, in_report, late) >= 1
    assert after(PLAN, [(0.0, "report", 1, 2), (5.0, "report", 2, 2)], 5.0) >= 1
    assert estimate_in_words(0.2) == "about 5 s left"


def test_a_step_that_takes_longer_than_those_before_adds_to_the_estimate():
    steady = [(float(done), "tracking", done, 10) for done in range(6)]
    assert after([], steady, 5.0) == pytest.approx(5)
    assert after([], steady, 45.0) > 5


def test_a_stage_that_is_not_planned_is_judged_by_its_own_pace():
    assert after([], [(0.0, "drawing", 0, None)], 3.0) is None
    assert after([], [(0.0, "drawing", 0, 10), (2.0, "drawing", 1, 10)], 2.0) == pytest.approx(18)


def test_a_stage_that_comes_for_every_object_is_planned_for_each():
    plan = [PLAN[0], *2 * PLAN[1:]]
    first = [(0.0, "tracking", 1, 1), (40.0, "refining poses", 0, 4), (60.0, "report", 0, None)]
    assert after(plan, [*first, (70.0, "refining poses", 0, 4)], 70.0) == pytest.approx(30, rel=0.1)


def test_an_interrupted_stage_goes_on_and_counts_once():
    """A stage that is in no plan comes between, again and again."""
    reports = []
    for part in range(4):
        begin = 20.0 * part
        reports += [(begin + done, "tracking", 10 * part + done, 40) for done in range(11)]
        reports += [(begin + 10.0, "looking for a start", 0, None)]
    assert after(PLAN, reports[:-1], 70.0) == pytest.approx(30, rel=0.2)


def test_a_stage_with_fewer_steps_than_planned_costs_in_proportion():
    plan = [PlannedStage("refining frames", 40.0, 100), PlannedStage("report", 10.0)]
    assert after(plan, [(0.0, "refining frames", 0, 25)], 0.0) == pytest.approx(20)


def test_a_stage_that_is_left_out_costs_nothing():
    assert after(PLAN, [(0.0, "tracking", 1, 1), (40.0, "report", 0, None)], 40.0) == pytest.approx(
        10, rel=0.1
    )


class Clock:
    """A clock that goes on only when it is told to, and looks at a display every second."""

    def __init__(self, end: float) -> None:
        self.now, self._end = 0.0, end
        self.display: module._Line | None = None
        self.errors: list[float] = []
        self.shares: list[float] = []

    def work(self, seconds: float) -> None:
        for _ in range(round(seconds)):
            self.now += 1.0
            self.display._refresh()
            self.shares.append(self.display._bar.tasks[0].completed)
            left = self.display._remaining.seconds(self.now)
            self.errors.append(left / max(self._end - self.now, 1e-9) - 1)


@pytest.mark.parametrize("slower", [1, 2, 5])
def test_of_a_steady_run_with_an_interrupting_stage_the_bar_never_goes_back_and_the_time_left_is_right(
    monkeypatch, slower
):
    """Every tenth frame, a stage with the name of a later one comes within the tracking."""
    tracking, refining, report = 100 * slower + 10 * 4 * slower, 60 * slower, 40 * slower
    end = tracking + refining + report
    clock = Clock(end)
    monkeypatch.setattr(module.time, "monotonic", lambda: clock.now)
    clock.display = module._Line(Console(file=io.StringIO(), force_terminal=True))
    clock.display.expect(
        [
            PlannedStage("tracking", tracking / slower, 100),
            PlannedStage("refining poses", refining / slower),
            PlannedStage("report", report / slower, 20),
        ]
    )
    with listen_to_progress(clock.display.take):
        for frame in report_each("tracking", range(100)):
            clock.work(slower)
            if frame % 10 == 9:
                for _ in report_each("refining poses", range(2)):
                    assert clock.display._stage == f"tracking {frame}/100: refining poses"
                    clock.work(2 * slower)
        for _ in report_each("refining poses", range(6)):
            clock.work(10 * slower)
        for _ in report_each("report", range(20)):
            clock.work(2 * slower)
    assert clock.shares == sorted(clock.shares)
    # From when its speed is known, for which 6 % of it suffice, until its last steps.
    told = clock.errors[1 if slower == 1 else end // 16 : -3 * slower]
    assert max(map(abs, told)) < 0.2


def test_before_the_first_report_nothing_is_known():
    assert after(PLAN, [], 3.0) is None


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (1.0, "about 5 s left"),
        (61.0, "about 1 min 05 s left"),
        (130.0, "about 2 min 30 s left"),
        (3700.0, "about 1 h 02 min left"),
    ],
)
def test_an_estimate_in_words_is_no_more_exact_than_it_is(seconds, words):
    assert estimate_in_words(seconds) == words


def test_the_plan_of_a_run_has_the_stages_that_its_settings_ask_for():
    config = load_config().model_dump()
    names = [stage.name for stage in plan_run(config, 10)]
    assert (names[0], names[-1]) == ("tracking", "turntable")
    assert "refining masks" in names and "matching depths" in names
    config["object"]["shape"] = "fast"
    assert "matching depths" not in [stage.name for stage in plan_run(config, 10)]
    config["solver"]["final_refine"], config["object"]["shape"] = False, "fine"
    names = [stage.name for stage in plan_run(config, 10, report=False)]
    assert "refining masks" not in names and "matching depths" in names and "turntable" not in names
    assert plan_run(config, None) == []


def test_the_plan_of_several_objects_and_of_a_correction_has_what_each_of_them_costs():
    config = load_config().model_dump()
    one, two = (plan_run(config, 100, objects) for objects in (1, 2))
    assert [stage.name for stage in two].count("turntable") == 2
    assert sum(stage.seconds for stage in two) == pytest.approx(2 * sum(stage.seconds for stage in one))
    corrected = plan_run(config, 100, kept=80)
    assert sum(stage.seconds for stage in corrected) < 0.6 * sum(stage.seconds for stage in one)
    assert "refining poses" not in [stage.name for stage in corrected]
