"""Notes and totals added to the description of a stopped run."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tracking3d.results import layout
from tracking3d.results.files import write_reserved
from tracking3d.results.records import jsonable
from tracking3d.results.run_writer import RESERVE
from tracking3d.runtime.memory import release_free_memory


def note_in_run(folder: Path, about: Mapping[str, Any]) -> None:
    """Add to what ``run.json`` of a run that has stopped says.

    Raises:
        OutputError: If it cannot be written.
    """
    path = folder / layout.RUN
    description = {**json.loads(path.read_bytes()), **jsonable(about)}
    write_reserved(path, json.dumps(description, indent=2, allow_nan=False).encode() + b"\n", RESERVE)


@contextmanager
def timed_pass(folder: Path, name: str) -> Iterator[None]:
    """Within is a pass of a run that has stopped; ``timings`` of its ``run.json`` gets the seconds that it takes."""
    release_free_memory()
    began = time.monotonic()
    yield
    seconds = time.monotonic() - began
    if timings := json.loads((folder / layout.RUN).read_bytes()).get("timings"):
        before = timings.get("passes", {"earlier": timings["seconds_total"]})
        passes = before | {name: before.get(name, 0.0) + seconds}
        note_in_run(folder, {"timings": timings | {"seconds_total": sum(passes.values()), "passes": passes}})
