"""Small videos with prompts beside them, a recording that takes a moment, and a batch without workers."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from recorded_runs import estimate_of, frame_of, model, open_run
from small_videos import BOX, write_video

from tracking3d.batch.listing import list_jobs
from tracking3d.batch.running import run_batch
from tracking3d.config.loading import load_config
from tracking3d.engines.choosing import InThisProcess
from tracking3d.errors import OutputError


@pytest.fixture
def videos(tmp_path):
    """``one.mp4`` and ``in/two.mp4``, each with a box beside it."""
    folder = tmp_path / "videos"
    for name in ("one", "in/two"):
        write_video(folder / f"{name}.mp4").with_suffix(".box").write_text(BOX + "\n")
    return folder


class Recorded:
    """Stands for `tracking3d.pipeline.record.record_tracking`: two frames are there at once, unless it is to fail
    first.

    Args:
        run: That run.

    Attributes:
        calls: What it was called with.
        faults: What to raise, by a part of the source's name, one after the other.
    """

    def __init__(self, run: Path) -> None:
        self._run = run
        self.calls: list[dict[str, Any]] = []
        self.faults: dict[str, list[BaseException]] = {}

    def __call__(self, request: Any, folder: Path, options: Any, listener: Any) -> None:
        several = request.prompts.as_lists
        for number in range(max(len(request.prompts), 1)):
            self._one(request.source, folder / f"object_{number}" if several else folder, options, listener)

    def _one(self, source: Any, folder: Path, options: Any, listener: Any) -> None:
        self.calls.append({"source": source, "folder": folder, "resume": options.resume})
        faults = next((faults for part, faults in self.faults.items() if part in source.name), [])
        shutil.rmtree(folder, ignore_errors=True)
        if faults:
            folder.mkdir(parents=True)
            raise faults.pop(0)
        for frame in source:
            listener(frame)
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(self._run, folder)


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory):
    """Of two frames; its source is nowhere."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    with open_run(folder) as writer:
        for index in range(2):
            writer.write(estimate_of(index), frame_of(index))
        writer.finish(model(), "finished")
    return folder


@pytest.fixture
def recorded(monkeypatch, finished_run):
    record = Recorded(finished_run)
    monkeypatch.setattr("tracking3d.pipeline.record.record_tracking", record)
    return record


@pytest.fixture
def batch(recorded, tmp_path):
    """Run a batch into ``out`` in this process; gives how far it came and what happened."""

    def run(place: Any, out: Any = tmp_path / "out", configure: Any = lambda row: load_config(), **more: Any):
        told: list[Any] = []
        jobs = list_jobs(str(place), configure)
        options = {"report": False, "pause": 0.0, **more}
        progress = run_batch(jobs, str(out), InThisProcess(), listener=told.append, **options)
        return progress, told

    return run


@pytest.fixture
def full_disk(monkeypatch):
    """Let writing files of some name fail."""

    def fill(module: Any, name: str) -> None:
        write = module.write

        def refused(place: str, content: bytes) -> None:
            if place.endswith(name):
                raise OutputError(f"The disk is full at {place}; free some space.")
            write(place, content)

        monkeypatch.setattr(module, "write", refused)

    return fill
