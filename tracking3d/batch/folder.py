"""The folder of a batch: its tables, which grow as videos finish, and its progress; readable at any time."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from tracking3d.batch.storage import join_path, read, write
from tracking3d.errors import InputError

PROGRESS, RESULTS, PARQUET, FAILURES = "progress.json", "results.csv", "results.parquet", "failures.csv"
FORMAT = "tracking3d-batch"
_FAILURE = ("run", "video", "reason", "attempts", "crashed", "log")
_SILENT = 120.0  # seconds after which a batch that says nothing is taken for ended


@dataclass(frozen=True)
class Failure:
    """A video that came to nothing."""

    run: str  # what its run folder would have been called
    video: str  # the video
    reason: str  # why, in a sentence
    attempts: int  # how often it was begun
    crashed: bool  # whether its process ended
    log: str  # path of its log


@dataclass(frozen=True)
class BatchProgress:
    """How far a batch is."""

    state: str  # running, finished or interrupted
    total: int  # videos
    finished: int = 0  # number of finished videos
    failed: int = 0  # those that came to nothing
    before: int = 0  # finished videos that were so before the command began
    # by worker: the video, how many frames of how many, since when, at which attempt
    running: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    engine: str = ""  # the engine that runs them, in words
    workers: int = 0  # how many videos at a time
    began: float = 0.0  # when, in seconds since 1970
    updated: float = 0.0  # when this was written
    seconds_to_go: float | None = None  # about how long it will take; None if unknown yet

    @property
    def state_in_words(self) -> str:
        """The state; with a remark if the batch has not reported for long."""
        silent = time.time() - self.updated
        if self.state == "running" and silent > _SILENT:
            return f"running, but without progress for {silent / 60:.0f} minutes"
        return self.state


def write_progress(out: str, progress: BatchProgress) -> BatchProgress:
    """Write how far the batch is, with the time of now.

    Raises:
        OutputError: If it cannot be written.
    """
    progress = replace(progress, updated=time.time())
    write(
        join_path(out, PROGRESS),
        json.dumps({"format": FORMAT, **asdict(progress)}, indent=1).encode() + b"\n",
    )
    return progress


def read_progress(out: str) -> BatchProgress:
    """How far a batch is.

    Raises:
        InputError: If the folder is none of a batch, or a file there is damaged.
    """
    content = read(join_path(out, PROGRESS))
    if content is None:
        raise InputError(
            f"{out} is not a batch folder: it holds no {PROGRESS}; give the --out folder of a batch."
        )
    try:
        document = json.loads(content)
        if document.pop("format") != FORMAT:
            raise ValueError("another format")
        return BatchProgress(**document)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{join_path(out, PROGRESS)} is damaged ({error}); run the batch again.") from error


def write_tables(out: str, rows: Sequence[Mapping[str, Any]], failures: Iterable[Failure]) -> None:
    """Replace the tables, each as a whole: CSV, and Parquet too if pyarrow is installed.

    Raises:
        OutputError: If one cannot be written; it is then as it was.
    """
    from tracking3d.batch.summary import COLUMNS

    write(join_path(out, RESULTS), _csv(COLUMNS, rows))
    write(join_path(out, FAILURES), _csv(_FAILURE, [asdict(one) for one in failures]))
    if (content := _parquet(rows)) is not None:
        write(join_path(out, PARQUET), content)


def read_failures(out: str) -> list[Failure]:
    """The videos that came to nothing.

    Raises:
        InputError: If the table is damaged.
    """
    content = read(join_path(out, FAILURES)) or b""
    try:
        return [
            Failure(**row | {"attempts": int(row["attempts"]), "crashed": row["crashed"] == "True"})
            for row in csv.DictReader(io.StringIO(content.decode("utf-8")), strict=True)
        ]
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(f"{join_path(out, FAILURES)} is damaged ({error}); run the batch again.") from error


def read_result_rows(out: str) -> list[dict[str, str]]:
    """The rows of the table of results, as texts."""
    content = read(join_path(out, RESULTS)) or b""
    return list(csv.DictReader(io.StringIO(content.decode("utf-8", "replace"))))


def _csv(columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode("utf-8", "replace")


def _parquet(rows: Sequence[Mapping[str, Any]]) -> bytes | None:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return None
    from tracking3d.batch.summary import COLUMNS

    types = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    schema = pyarrow.schema([(name, types[kind]) for name, kind in COLUMNS.items()])
    table = pyarrow.Table.from_pylist([{name: row.get(name) for name in COLUMNS} for row in rows], schema)
    stream = io.BytesIO()
    parquet.write_table(table, stream)
    return stream.getvalue()
