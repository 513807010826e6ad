"""A real run, watched in a terminal: its stages are named in their order, with counts, and it is never silent."""

from __future__ import annotations

import json
import os
import re
import select
import sys
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from forked import forked_in_terminal

from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import make_demo_clip

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal of POSIX")

QUICK = ["--size", "32", "--set", "object.frequency=2", "--set", "tracker.segmentation_size=64"]
FRAMES = 8
LONGEST_SILENCE = 2.0
"""Seconds, counted in looks at the terminal: a machine that stops both programs for a while adds none."""
_LOOK = 0.1
_CONTROL = re.compile(rb"\x1b\[[0-9;?]*[A-Za-z]|\r")
_STAGE = re.compile(r"[^\w\n]((?:tracking|refining|texture|report|turntable)(?: [a-z]+)*)(?: (\d+)/(\d+))?")


@dataclass(frozen=True)
class Watched:
    """What a terminal showed.

    Attributes:
        text: All of it, without control sequences.
        longest_silence: Seconds between two outputs.
        last_words: What was shown before the longest silence.
    """

    text: str
    longest_silence: float
    last_words: str


def watch(terminal: int, process: BaseProcess) -> Watched:
    """Read what a process writes into a terminal until it ends."""
    shown, silence, longest, words = b"", 0.0, 0.0, b""
    process.start()
    while process.is_alive():
        ready, _, _ = select.select([terminal], [], [], _LOOK)
        if ready:
            shown, silence = shown + os.read(terminal, 65536), 0.0
        elif (silence := silence + _LOOK) > longest:
            longest, words = silence, shown[-200:]
    process.join()
    text, words = (_CONTROL.sub(b"", part) for part in (shown, words))
    return Watched(text.decode(errors="replace"), longest, words.decode(errors="replace"))


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    return make_demo_clip(tmp_path_factory.mktemp("terminal") / "clip", frames=FRAMES, size=(96, 72))


def in_terminal(*arguments: object) -> Watched:
    import pty

    ours, theirs = pty.openpty()
    try:
        process = forked_in_terminal(os.ttyname(theirs), *arguments)
        watched = watch(ours, process)
        assert process.exitcode == 0, watched.text
        return watched
    finally:
        os.close(ours)
        os.close(theirs)


def stages(text: str) -> dict[str, set[tuple[int, int]]]:
    """The counts that were shown with each stage, in the order of the stages."""
    shown: dict[str, set[tuple[int, int]]] = {}
    for name, done, total in _STAGE.findall(text):
        counts = shown.setdefault(name.strip(), set())
        if total:
            counts.add((int(done), int(total)))
    return shown


def test_a_run_names_its_stages_with_counts_and_is_never_silent(clip, tmp_path):
    box = ",".join(str(value) for value in json.loads((clip / "init.json").read_text())["bbox_xywh"])
    run = tmp_path / "run"
    watched = in_terminal("run", clip / "frames", "--box", box, *QUICK, "--out", run)
    assert RunReader(run).state == "finished"
    assert watched.longest_silence < LONGEST_SILENCE, watched.last_words
    shown = stages(watched.text)
    expected = ["tracking", "refining frames", "refining masks", "turntable"]
    assert [name for name in shown if name in expected] == expected, shown
    assert {total for _, total in shown["tracking"]} == {FRAMES}
    assert len(shown["turntable"]) > 1
    assert not re.search(r"0:00\b|about 0 s", watched.text)
    assert re.search(r"about [\w ]+ left", watched.text)


def test_quiet_shows_nothing_in_a_terminal(clip, tmp_path):
    box = ",".join(str(value) for value in json.loads((clip / "init.json").read_text())["bbox_xywh"])
    options = ("--quiet", "--set", "solver.final_refine=false", "--no-report", "--frames", "0:2")
    assert (
        in_terminal("run", clip / "frames", "--box", box, *QUICK, *options, "--out", tmp_path / "run").text
        == ""
    )
