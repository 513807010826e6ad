"""A run can be looked at while it goes on: its video plays, and its contact sheet is refreshed."""

from __future__ import annotations

import io
from pathlib import Path

import av
import numpy as np
from PIL import Image
from recorded_runs import estimate_of, frame_of, model, open_run

from tracking3d.results import layout, run_writer
from tracking3d.runtime.concurrency import RegularWork
from tracking3d.video import open_source


def test_the_video_plays_when_the_run_is_half_done_and_has_an_index_at_its_end(tmp_path: Path):
    video = tmp_path / "run" / layout.OVERLAY
    with open_run(tmp_path / "run") as writer:
        for index in range(12):
            writer.write(estimate_of(index), frame_of(index))
            if index == 6:
                half = list(open_source(video))
        writer.finish(model(), "finished")
    assert len(half) == 6
    assert b"moof" not in video.read_bytes()
    with av.open(str(video)) as container:
        assert container.streams.video[0].frames == 12


def test_the_contact_sheet_is_there_and_refreshed_while_the_run_goes_on(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(run_writer, "SHEET_EVERY", 0.0)
    monkeypatch.setattr(run_writer, "SHEET_SHARE", np.inf)
    sheet = tmp_path / "run" / layout.CONTACT_SHEET
    sheets = []
    with open_run(tmp_path / "run") as writer:
        for index in range(3):
            writer.write(estimate_of(index), frame_of(index))
            sheets.append(sheet.read_bytes())
            Image.open(io.BytesIO(sheets[-1])).load()
        assert len(set(sheets)) == 3
        writer.finish(model(), "finished")
    assert sheet.read_bytes() != sheets[-1]  # it has the model now


def test_regular_work_waits_as_long_as_is_asked_and_longer_if_it_takes_long(monkeypatch):
    now, done = [0.0], []

    def job() -> None:
        done.append(now[0])
        now[0] += takes[0]

    monkeypatch.setattr("time.monotonic", lambda: now[0])
    takes, work = [0.01], RegularWork(job, every=5.0, share=0.01)
    while now[0] < 19:
        work.do_if_due()
        now[0] += 1
    assert [round(at) for at in done] == [5, 10, 15]
    takes[0] = 1.0
    while now[0] < 250:
        work.do_if_due()
        now[0] += 1
    assert [round(at) for at in done] == [5, 10, 15, 20, 120, 220]
