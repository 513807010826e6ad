"""What hours of video cost, by the figures of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from recorded_runs import write_run

from tracking3d.errors import InputError
from video_costs import Machine, RunFigures, cost_of, figures_of, markdown

FIGURES = RunFigures(
    seconds=0.5, decoding=0.01, seconds_once=30, bytes_read=1e4, bytes_written=2e4, bytes_once=6e6, memory=1e9
)
MACHINE = Machine(processors=10, memory=32e9, disk=1e8, network=1e8)


def test_hours_are_frames_times_seconds_and_what_each_video_takes_once():
    cost = cost_of(2, FIGURES, MACHINE, fps=10, minutes=5)
    frames, videos = 2 * 3600 * 10, 2 * 60 / 5
    assert cost.processor_hours == pytest.approx((frames * 0.5 + videos * 30) / 3600)
    assert cost.written == pytest.approx(frames * 2e4 + videos * 6e6)
    assert cost.read == pytest.approx(frames * 1e4)
    assert cost.machine_hours == pytest.approx(cost.processor_hours / 10)
    assert (cost.bottleneck, cost.workers) == ("processors", 10)


@pytest.mark.parametrize(
    ("binds", "machine"),
    [
        ("memory", replace(MACHINE, memory=3.5e9)),
        ("disk", replace(MACHINE, disk=1e5)),
        ("network", replace(MACHINE, network=1e5)),
    ],
)
def test_what_is_scarce_binds(binds, machine):
    cost = cost_of(10, FIGURES, machine)
    assert cost.bottleneck == binds
    assert cost.machine_hours > cost_of(10, FIGURES, MACHINE).machine_hours
    assert cost.workers == (3 if binds == "memory" else 10)


def test_a_run_too_large_for_the_machine_is_refused():
    with pytest.raises(InputError, match="memory"):
        cost_of(1, FIGURES, replace(MACHINE, memory=1e8))


@pytest.mark.parametrize("wrong", [{"hours": 0}, {"fps": -1}, {"minutes": float("nan")}])
def test_numbers_without_sense_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        cost_of(**{"hours": 1.0, "figures": FIGURES, "machine": MACHINE, **wrong})


def test_figures_are_those_of_the_run(tmp_path):
    run = write_run(tmp_path / "run", 10)
    figures = figures_of(run, tmp_path / "run_frames")
    assert figures.seconds == pytest.approx(
        0.1, rel=0.5
    )  # what its frames say of themselves, and their writing
    assert figures.bytes_read * 10 == pytest.approx(size_of(tmp_path / "run_frames"))
    assert figures.bytes_written * 10 + figures.bytes_once == pytest.approx(size_of(run))
    assert figures.memory > 1e7


def size_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def test_a_table_has_a_row_for_each():
    cost = cost_of(1000, FIGURES, MACHINE)
    assert markdown({"a": cost, "b": cost}).count("\n") == 4
