"""Whole processes: interrupted at odd moments, without a terminal, a home, or a place to write."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from damaging import pick
from judging import SECONDS, Case

CODE = "from tracking3d.cli import main; main()"
ROOT = Path(__file__).resolve().parents[2]


def processes(case: Case) -> None:
    """Run in a process of its own under odd circumstances."""
    pick(
        case.random, [_interrupted, _interrupted, _without_streams, _without_home, _deep_folder, _read_only]
    )(case)


def _arguments(case: Case, *more: object) -> list[str]:
    words = ["run", case.material.folder / "images", "--config", case.material.folder / "tiny.yaml"]
    words += ["--box", case.material.box, "--out", case.folder / "out", *more]
    return [sys.executable, "-c", CODE, *map(str, words)]


def _environment(**more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **more}


def _ended(case: Case, process: subprocess.Popen, codes: tuple[int, ...]) -> None:
    output, errors = process.communicate(timeout=SECONDS)
    said = (output or b"").decode("utf-8", "replace") + (errors or b"").decode("utf-8", "replace")
    assert "Traceback" not in said, said
    assert "bug in tracking3d" not in said, said
    assert process.returncode in codes, (process.returncode, said)


def _interrupted(case: Case) -> None:
    """Ctrl-C at any moment: from the first import to the last file."""
    command = _arguments(case)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, env=_environment(), cwd=case.folder, **streams) as process:
        lines = case.folder / "out/frames.jsonl"
        deadline = time.monotonic() + SECONDS
        while not lines.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(float(case.random.random()) * 2)
        process.send_signal(signal.SIGINT)
        _ended(case, process, (0, 130))


def _without_streams(case: Case) -> None:
    """With some of the standard streams closed, as under cron or a badly written daemon."""
    closed = pick(
        case.random, ["0<&-", "0<&- 1>&-", "0<&- 2>&-", "0<&- 1>&- 2>&-", "1>/dev/null 2>/dev/null"]
    )
    case.story.append(closed)
    command = ["bash", "-c", f'exec "$@" {closed}', "bash", *_arguments(case)]
    with subprocess.Popen(command, env=_environment(TERM="dumb"), cwd=case.folder) as process:
        _ended(case, process, (0,))
    assert (case.folder / "out/frames.jsonl").read_text().count("\n") >= 3


def _without_home(case: Case) -> None:
    """Without a home, or with one that cannot be written."""
    environment = _environment()
    kind = int(case.random.integers(3))
    for name in ("HOME", "XDG_CACHE_HOME", "USER", "LOGNAME", "LANG", "TERM"):
        environment.pop(name, None)
    if kind:
        environment["HOME"] = "/proc/nowhere" if kind == 1 else "/dev/null"
    case.story.append(f"HOME {environment.get('HOME')}")
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(_arguments(case), env=environment, cwd=case.folder, **streams) as process:
        _ended(case, process, (0,))


def _deep_folder(case: Case) -> None:
    """Into a folder whose name is as long as names get, or that cannot be made."""
    out = pick(
        case.random,
        [Path("/".join(["x" * 200] * 10)), Path("y" * 300), Path("/proc/out"), Path("/dev/null/x")],
    )
    case.story.append(f"out {out!s:.40}")
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = _arguments(case, "--out", out)
    with subprocess.Popen(command, env=_environment(), cwd=case.folder, **streams) as process:
        _ended(case, process, (0, 2))


def _read_only(case: Case) -> None:
    """From a working directory that cannot be written, into it and elsewhere."""
    place = case.folder / "read only"
    place.mkdir(mode=0o555)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL}
    # Without these capabilities the superuser, too, has to keep to the permissions of files.
    drop = ["setpriv", "--bounding-set=-dac_override,-dac_read_search,-fowner"]
    drop = drop if os.geteuid() == 0 and shutil.which("setpriv") else []
    elsewhere = case.random.random() < 0.5
    command = [*drop, *_arguments(case, "--out", case.folder / "out" if elsewhere else "runs/here")]
    case.story.append("elsewhere" if elsewhere else "into it")
    expected = (0,) if elsewhere else (2,) if drop or os.geteuid() else (0, 2)
    with subprocess.Popen(command, env=_environment(), cwd=place, **streams) as process:
        _ended(case, process, expected)
