"""A case, and what holds of every one: no traceback, no hanging, no finished frame lost."""

from __future__ import annotations

import faulthandler
import json
import logging
import signal
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from material import Material
from numpy.random import Generator
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import Tracking3dError
from tracking3d.results.run_reader import RunReader

SECONDS = 120
"""A case that takes longer hangs; most take less than one."""


class TooSlow(BaseException):
    """The time of a case is over; nothing catches this but the judge."""


@dataclass
class Case:
    """What one case does, in words as it goes on, and how.

    Attributes:
        random: Everything random comes from here.
        material: What to spoil copies of.
        folder: The case's own, and its working directory.
        story: What was done, for who repeats it.
    """

    random: Generator
    material: Material
    folder: Path
    story: list[str] = field(default_factory=list)

    def command(self, *arguments: object) -> int:
        """Call the command line; it ends with 0, or with 2 and a sentence. Returns which."""
        words = [str(argument) for argument in arguments]
        self.story.append(f"tracking3d {words}")
        result = CliRunner().invoke(app, words)
        output = result.stdout + result.stderr
        assert "Traceback" not in output or "--debug" in words, output
        assert "bug in tracking3d" not in output, output
        assert result.exit_code in (0, 2), (result.exit_code, output, result.exception)
        if result.exit_code == 2:
            errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
            assert len(errors) == 1 and errors[0].endswith((".", "?", ")", "`")), output
        check_folders(self.folder)
        return result.exit_code

    def run(self, source: object, *arguments: object, box: bool = True) -> int:
        """Call ``tracking3d run`` on ``source`` with the settings of tiny runs."""
        prompt = ("--box", self.material.box) if box else ()
        config = ("--config", self.material.folder / "tiny.yaml")
        return self.command("run", *config, *prompt, "--out", self.folder / "out", *arguments, "--", source)

    def call(self, what: str, function: Callable[[], Any]) -> None:
        """Call the library; it answers, or raises what docs/library.md promises."""
        self.story.append(what)
        try:
            function()
        except Tracking3dError as error:
            sentence = str(error)
            assert sentence.strip() and "\n" not in sentence.strip(), sentence
            assert "--" not in sentence, f"a library call is told of an option: {sentence}"
        check_folders(self.folder)


def check_folders(folder: Path) -> None:
    """Every frame that a run tells of is there, and no run says that it still goes on."""
    for lines in folder.rglob("frames.jsonl"):
        run = lines.parent
        if not (run / "untouched").exists():  # folders that a case spoils are not the program's to answer for
            reader = RunReader(run)
            assert reader.state in ("finished", "failed", "interrupted"), reader.state
            counted = json.loads((run / "run.json").read_text())["counts"]["frames"]
            indices = {json.loads(line)["index"] for line in lines.read_text().splitlines()}
            assert counted == len(indices), (counted, indices)
            assert all(reader.mask(index).shape for index in indices)


def generator(seed: int, domain: str, number: int) -> Generator:
    """The random numbers of one case, whatever other cases there are."""
    return np.random.default_rng([seed, zlib.crc32(domain.encode()), number])


@contextmanager
def judged(case: Case, name: str, seed: int) -> Iterator[None]:
    """Give the case its time, and tell its seed and story if it fails.

    Python code is interrupted after `SECONDS`; where a library hangs in C, the process ends some time later with the
    stack of every thread.
    """
    story = f"{name} with TRACKING3D_FUZZ_SEED={seed}"

    def too_slow(*_: object) -> None:
        raise TooSlow(f"{story} took more than {SECONDS} s: {case.story}")

    before = signal.signal(signal.SIGALRM, too_slow)
    level = logging.getLogger("tracking3d").level
    signal.alarm(SECONDS)
    faulthandler.dump_traceback_later(2 * SECONDS, exit=True, file=sys.__stderr__)
    try:
        yield
    except BaseException as error:
        error.add_note(f"{story}: {'; '.join(case.story)}")
        raise
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        logging.getLogger("tracking3d").setLevel(level)
