"""Tables of videos: CSV, JSON Lines and Parquet, here or elsewhere."""

from __future__ import annotations

import csv
import io
import json
from pathlib import PurePosixPath
from typing import Any

from tracking3d.batch.rows import VideoRow, read_row
from tracking3d.batch.storage import read
from tracking3d.errors import InputError

SUFFIXES = (".csv", ".jsonl", ".ndjson", ".parquet")


def is_table(place: str) -> bool:
    """Whether a place is called as a table is."""
    return PurePosixPath(place).suffix.lower() in SUFFIXES


def read_table(place: str) -> list[VideoRow]:
    """The rows of a table.

    Raises:
        InputError: If there is no such table, a column is unknown, or a value cannot be one; the row is named.
    """
    content = read(place)
    if content is None:
        raise InputError(f"The table {place} does not exist.")
    suffix = PurePosixPath(place).suffix.lower()
    try:
        if suffix == ".parquet":
            rows = _parquet(content)
        elif suffix == ".csv":
            rows = _csv(content)
        else:
            lines = content.decode("utf-8-sig").splitlines()
            rows = [(number, json.loads(line)) for number, line in enumerate(lines, 1) if line.strip()]
    except (ValueError, csv.Error) as error:
        raise InputError(f"The table {place} cannot be read ({error}).") from error
    if not rows:
        raise InputError(f"The table {place} has no rows.")
    if odd := next((number for number, values in rows if not isinstance(values, dict)), None):
        raise InputError(f"Line {odd} of {place} is not a JSON object with a value for each column.")
    return [read_row(values, f"Line {number} of {place}") for number, values in rows]


def _csv(content: bytes) -> list[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
    columns = reader.fieldnames or ()
    if twice := next((name for name in columns if list(columns).count(name) > 1), None):
        raise ValueError(f"it has two columns {twice}; remove one")
    rows = []
    for values in reader:
        more = values.pop(None, None)
        if more:
            raise ValueError(f"line {reader.line_num} has more values than there are columns")
        rows.append((reader.line_num, values))
    return rows


def _parquet(content: bytes) -> list[tuple[int, dict[str, Any]]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise InputError("Parquet tables need pyarrow: pip install 'tracking3d[export]'.") from error
    try:
        table = parquet.read_table(io.BytesIO(content))
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(str(error)) from error
    return list(enumerate(table.to_pylist(), 1))
