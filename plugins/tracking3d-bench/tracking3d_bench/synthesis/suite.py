"""The suites of synthetic sequences, fixed or generated from a seed, and identical everywhere for one version."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from importlib import resources
from multiprocessing import get_context
from pathlib import Path

import cv2

from tracking3d.config.explain import hint
from tracking3d.config.loading import read_mapping
from tracking3d.errors import InputError, OutputError
from tracking3d.results.files import write_atomic, writing
from tracking3d_bench.synthesis.fresh import FRESH, fresh_suite, seed_of
from tracking3d_bench.synthesis.phone import PHONE, phone_seed, phone_suite
from tracking3d_bench.synthesis.spec import SequenceSpec, check_spec
from tracking3d_bench.synthesis.writing import SUITE_VERSION, is_complete, write_sequence

__all__ = ["SEEDED", "SUITES", "SUITE_VERSION", "is_suite", "load_suite", "make_suite"]

SUITES = ("smoke", "standard", "hard", "full")
"""The fixed suites by name, in order of size."""

SEEDED = (FRESH, PHONE)
"""The suites that are generated from a seed."""


def is_suite(name: str) -> bool:
    """Whether `load_suite` knows a suite of this name, or would if it had a seed."""
    return name in (*SUITES, *SEEDED) or seed_of(name) is not None or phone_seed(name) is not None


def load_suite(name: str) -> list[SequenceSpec]:
    """The sequences of a suite: one of `SUITES`, or ``fresh-SEED`` or ``phone-SEED``.

    Raises:
        InputError: If there is no such suite.
    """
    if (seed := seed_of(name)) is not None:
        return fresh_suite(seed)
    if (seed := phone_seed(name)) is not None:
        return phone_suite(seed)
    if name in SEEDED:
        raise InputError(f"The suite {name} is generated from a seed; give --seed N, or the name {name}-N.")
    if name not in SUITES:
        known = (*SUITES, *SEEDED)
        raise InputError(f"There is no suite '{name}'; {hint(name, known)}")
    with resources.as_file(resources.files("tracking3d_bench.synthesis") / "suites" / f"{name}.yaml") as file:
        document = read_mapping(file)
    common = document.get("common", {})
    return [check_spec({**common, **one}, f"suite {name}") for one in document["sequences"]]


def make_suite(
    name: str,
    folder: Path,
    *,
    specs: Sequence[SequenceSpec] | None = None,
    jobs: int = 1,
    overwrite: bool = False,
    listener: Callable[[str], None] = lambda name: None,
) -> list[Path]:
    """Make the sequences of a suite that are not there yet, one folder for each, and ``suite.json``.

    Args:
        name: One of `SUITES`, or what a suite with sequences of its own is called.
        folder: Where to write; made if absent.
        specs: The sequences; those of `load_suite` if left out.
        jobs: Processes.
        overwrite: Make complete sequences too.
        listener: Called with the name of every generated sequence.

    Returns:
        The folders of all sequences, in the order of the suite.

    Raises:
        InputError: If there is no such suite, or Embree is not installed.
        OutputError: If it cannot be written.
    """
    specs = load_suite(name) if specs is None else specs
    missing = [spec for spec in specs if overwrite or not is_complete(folder / spec.name, spec)]
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    if jobs == 1 or len(missing) < 2:
        for spec in missing:
            write_sequence(folder / spec.name, spec)
            listener(spec.name)
    else:
        _in_parallel(missing, folder, jobs, listener)
    names = [spec.name for spec in specs]
    document = {"name": name, "version": SUITE_VERSION, "sequences": names}
    write_atomic(folder / "suite.json", json.dumps(document, indent=1).encode() + b"\n")
    return [folder / name for name in names]


def _in_parallel(specs: list[SequenceSpec], folder: Path, jobs: int, listener: Callable[[str], None]) -> None:
    # Spawned, for a forked process inherits locks that threads of the parent hold.
    with ProcessPoolExecutor(min(jobs, len(specs)), get_context("spawn"), _start) as pool:
        waiting = {pool.submit(write_sequence, folder / spec.name, spec): spec.name for spec in specs}
        try:
            for done in as_completed(waiting):
                done.result()
                listener(waiting[done])
        except BrokenProcessPool as error:
            raise OutputError(
                f"A process that generates sequences in {folder} was killed, for example because memory ran "
                "out; run again with fewer --jobs. Finished sequences are kept."
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _start() -> None:
    """One thread a process; Ctrl-C ends it without a traceback."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
