"""The soak: what it plays, what it measures, and when it says that something grows."""

from __future__ import annotations

import numpy as np
import pytest

import looped_run
from looped_run import Sample, SoakReport, looped_clip, track_looped, trends
from soak_report import format_soak, plot_soak
from tracking3d.config.loading import load_config
from tracking3d.frames import SkippedFrame
from tracking3d.results.run_reader import RunReader

QUICK = [
    "window.size=32",
    "object.frequency=3",
    "object.texture_size=48",
    "tracker.name=flow",
    "tracker.segmentation_size=64",
]


def samples(count: int, memory=lambda n: 100.0, files=lambda n: 12, seconds=lambda n: 0.1) -> list[Sample]:
    return [Sample(n, seconds(n), memory(n), files(n), "tracked") for n in range(count)]


def test_the_object_leaves_and_returns_without_a_jump():
    images, mask, _ = looped_clip((120, 90))
    difference = np.abs(np.diff(images.astype(float), axis=0)).mean((1, 2, 3))
    seam = np.abs(images[0].astype(float) - images[-1]).mean()
    assert seam <= difference.max()
    gone = images[75].astype(float)
    present = [np.abs(image.astype(float) - gone)[mask].mean() for image in images]
    assert present[0] > 20 > 5 > present[76]


def test_what_stays_as_it_is_is_flat_whatever_came_before():
    found = trends(samples(2000, memory=lambda n: min(n, 400)), 100)
    assert {name: trend.flat for name, trend in found.items()} == {
        "memory": True,
        "descriptors": True,
        "seconds": True,
    }


@pytest.mark.parametrize(
    ("grown", "by"),
    [
        ("memory", {"memory": lambda n: 100 + n * 0.01}),
        ("descriptors", {"files": lambda n: 12 + n // 100}),
        ("seconds", {"seconds": lambda n: 0.1 + n * 5e-5}),
    ],
)
def test_what_grows_is_told(grown, by):
    found = trends(samples(2000, **by), 100)
    assert [name for name, trend in found.items() if not trend.flat] == [grown]
    report = SoakReport(2000, 20, {"tracked": 2000}, found, [])
    assert not report.flat
    assert format_soak(report).row_count == 3


def test_a_short_soak_says_nothing_of_growth():
    assert trends(samples(600), 100) == {}


def test_every_frame_is_measured_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(looped_run, "SETTLED", 2)
    report = track_looped(load_config(overrides=QUICK), tmp_path / "run", frames=4, size=(96, 72))
    run = RunReader(tmp_path / "run")
    assert (run.state, len(run.frames), report.frames) == ("finished", 4, 4)
    assert run.description["refinement"] is None
    assert all(sample.seconds > 0 for sample in report.samples)
    plot_soak(report, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5000


@pytest.mark.parametrize("taken", [0, 3])
def test_stopped_by_hand_it_tells_what_it_measured(tmp_path, monkeypatch, taken):
    def record(source, config, folder, mask, listener):
        for index in range(taken):
            listener(SkippedFrame(index, "none"))
        raise KeyboardInterrupt

    monkeypatch.setattr(looped_run, "record", record)
    if not taken:
        with pytest.raises(KeyboardInterrupt):
            track_looped(load_config(overrides=QUICK), tmp_path / "run", frames=10, size=(80, 60))
        return
    report = track_looped(load_config(overrides=QUICK), tmp_path / "run", frames=10, size=(80, 60))
    assert report.frames == taken and report.counts == {"skipped": taken}


@pytest.mark.slow
def test_nine_hundred_frames_are_flat(tmp_path):
    report = track_looped(load_config(overrides=QUICK), tmp_path / "run", frames=900, size=(96, 72))
    assert report.trends["memory"].flat and report.trends["descriptors"].flat, report.trends
