"""What a run shows where nobody watches a terminal: a line in the log every now and then."""

from __future__ import annotations

from tracking3d.cli import progress as module
from tracking3d.cli.progress import progress
from tracking3d.frames import SkippedFrame


def told(monkeypatch, capsys, quiet: bool) -> list[str]:
    """The lines printed of forty frames, three seconds each."""
    clock = iter(range(0, 1000, 3))
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with progress(40, quiet) as listener:
        for index in range(40):
            now[0] = float(next(clock))
            listener(SkippedFrame(index, "torn"))
    return capsys.readouterr().err.splitlines()


def test_a_log_gets_a_line_every_now_and_then(monkeypatch, capsys):
    lines = told(monkeypatch, capsys, quiet=False)
    assert 5 < len(lines) < 15
    assert lines[0] == "5 of 40: frame 4 skipped"


def test_quiet_is_quiet(monkeypatch, capsys):
    assert told(monkeypatch, capsys, quiet=True) == []


def test_a_short_run_prints_nothing(capsys):
    with progress(None, False) as listener:
        listener(SkippedFrame(0, "torn"))
    assert capsys.readouterr().err == ""
