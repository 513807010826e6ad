"""SIGKILL at random moments of a run, again and again, and what is left in the end.

``TRACKING3D_KILL_SEED`` chooses other moments, ``TRACKING3D_KILLS`` how many of them.
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from forked import forked
from refining_solver import StandInSolver
from resumable_runs import assert_alike, finished_frames

from tracking3d import load_config
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results.checkpoint.run_state import SAVED_EVERY
from tracking3d.results.layout import CAUSAL, has_state
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.video import open_source

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")

FRAMES, SIZE = 14, (120, 90)
SEED = int(os.environ.get("TRACKING3D_KILL_SEED", "13"))
KILLS = int(os.environ.get("TRACKING3D_KILLS", "100"))
QUICK = [
    "tracker.name=flow",
    "tracker.segmentation_size=64",
    "crop.size=32",
    "object.frequency=2",
    "camera.fov=45",
    "object.texture_size=48",
    "solver.local_window=4",
    "solver.keyframe_rotation=25",
]


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES, size=SIZE, supersample=1, degrees_per_frame=5))


def track(images: Path, folder: Path, mask, log: Path, quick: bool) -> None:
    """What the process that is killed does: a run, and a line for every frame that it solves.

    Args:
        quick: Answer by a solver that takes no time, so that the moments are those in which files are written.
    """
    if quick:
        SOLVERS["online"] = StandInSolver
    with log.open("a") as lines:
        lines.write(json.dumps(["begin", 0]) + "\n")
    for name in ("step", "refine_frame"):
        method = getattr(Session, name)

        def told(self, frame, *given, method=method, name=name):
            with log.open("a") as lines:
                lines.write(json.dumps([name, frame.index]) + "\n")
            return method(self, frame, *given)

        setattr(Session, name, told)
    record(open_source(str(images)), load_config(overrides=QUICK), folder, mask=mask, resume=True)


class Victims:
    """Processes that track, forked from one that has imported everything, so that a kill costs no start."""

    def __init__(self, images: Path, mask, quick: bool) -> None:
        self._given = images, mask, quick

    def start(self, folder: Path, log: Path) -> BaseProcess:
        images, mask, quick = self._given
        process = forked(track, images, folder, mask, log, quick)
        process.start()
        return process


def begun(log: Path) -> bool:
    return log.is_file() and "begin" in log.read_text()


def kill_and_resume(
    victims: Victims, folder: Path, log: Path, moments: random.Random, duration: float
) -> int:
    """Kill one run at random moments until it is finished all the same; says how often it was killed."""
    kills = answered = 0
    while True:
        starts = log.read_text().count("begin") if log.is_file() else 0
        process = victims.start(folder, log)
        while process.is_alive() and (log.read_text().count("begin") if log.is_file() else 0) == starts:
            time.sleep(0.002)  # the run begins when everything is imported
        process.join(moments.uniform(0, duration))
        if process.is_alive():
            process.kill()
            process.join()
            kills += 1
            now = finished_frames(folder)
            assert now >= answered - SAVED_EVERY, "frames before the saved state are lost"
            answered = now if has_state(folder) else 0  # a run without any state begins anew
            continue
        assert process.exitcode == 0
        return kills


def assert_little_was_done_twice(log: Path, kills: int) -> None:
    """After each start at most `SAVED_EVERY` frames that were finished are solved again, and the one in work.

    Estimates are written by another thread while the next frame is solved, so that the last finished frame may not be
    written yet.
    """
    order = [["step", n] for n in range(FRAMES)] + [["refine_frame", n] for n in range(FRAMES)]
    begun, again, allowed = -1, 0, False
    for line in log.read_text().splitlines():
        what = json.loads(line)
        if what[0] == "begin":
            allowed = True
            continue
        place = order.index(what)
        repeated = begun + 1 - place
        assert repeated == 0 or (allowed and 0 < repeated <= SAVED_EVERY + 1), f"{what} after {order[begun]}"
        again += repeated
        allowed, begun = False, place
    assert begun == len(order) - 1
    assert again <= (SAVED_EVERY + 1) * kills


def kill_runs(clip, images, tmp_path, kills: int, quick: bool) -> int:
    whole, log = tmp_path / "whole", tmp_path / "whole.log"
    victims = Victims(images, clip.masks[0], quick)
    process = victims.start(whole, log)
    while not begun(log):
        time.sleep(0.01)
    started = time.monotonic()
    process.join()
    duration = time.monotonic() - started
    assert process.exitcode == 0
    assert [frame.refined for frame in RunReader(whole).frames] == [True] * FRAMES
    assert (whole / CAUSAL).is_dir()
    moments, done, runs = random.Random(SEED), 0, 0
    while done < kills:
        folder, log = tmp_path / f"run_{runs}", tmp_path / f"run_{runs}.log"
        killed = kill_and_resume(victims, folder, log, moments, duration)
        assert_alike(folder, whole)
        assert_little_was_done_twice(log, killed)
        done, runs = done + killed, runs + 1
    print(f"{done} kills in {runs} runs of {duration:.1f} s, seed {SEED}: none lost, none torn")
    return done


@pytest.mark.slow
def test_a_few_kills_cost_no_answer(clip, images, tmp_path):
    assert kill_runs(clip, images, tmp_path, 3, quick=True) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("quick", [False, True], ids=["solving", "writing"])
def test_a_hundred_kills_cost_no_answer(clip, images, tmp_path, quick):
    assert kill_runs(clip, images, tmp_path, KILLS, quick) >= KILLS
