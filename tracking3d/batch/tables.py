"""Tables of videos: CSV, JSON Lines and Parquet, here or elsewhere."""

from __future__ import annotations

import codecs
import csv
import io
import json
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any

from tracking3d.batch.rows import UnusableRow, VideoRow, check_texts, printable, read_row
from tracking3d.batch.storage import read
from tracking3d.errors import InputError

SUFFIXES = (".csv", ".jsonl", ".ndjson", ".parquet")
_WITH_COLUMNS = (".csv", ".parquet")
_LONGEST_NAME = 240  # bytes that file systems allow, less a suffix


def is_table(place: str) -> bool:
    """Whether a place is called as a table is."""
    return PurePosixPath(place).suffix.lower() in SUFFIXES


def read_table(place: str) -> list[VideoRow | UnusableRow]:
    """The rows of a table, those that cannot be used among them.

    Raises:
        InputError: If there is no such table, it has a column of an unknown name, or no row can be used.
    """
    content = read(place)
    if content is None:
        raise InputError(f"The table {place} does not exist.")
    suffix = PurePosixPath(place).suffix.lower()
    try:
        if suffix == ".parquet":
            read_values = _parquet(content)
        elif suffix == ".csv":
            read_values = _csv(content)
        else:
            read_values = _json_lines(content)
        found = list(read_values)
    except (ValueError, csv.Error, RecursionError) as error:
        raise InputError(f"The table {place} cannot be read ({error}).") from error
    if not found:
        raise InputError(f"The table {place} has no rows.")
    rows: list[VideoRow | UnusableRow] = []
    for number, values in found:
        try:
            rows.append(_row(values, f"Line {number} of {place}"))
        except InputError as error:
            known = not isinstance(values, dict) or values.keys() <= VideoRow.model_fields.keys()
            if not known and suffix in _WITH_COLUMNS:  # wrong in every row
                raise
            video = values.get("video") if isinstance(values, dict) else None
            video = printable(video) if isinstance(video, str) else ""
            rows.append(UnusableRow(number, video, str(error)))
    first = rows[0]
    if isinstance(first, UnusableRow) and all(isinstance(row, UnusableRow) for row in rows):
        raise InputError(first.reason)
    return rows


def _row(values: Any, where: str) -> VideoRow:
    """The row of what a line holds, or of why it could not be read.

    Raises:
        InputError: If it cannot be one.
    """
    if isinstance(values, ValueError):
        raise InputError(f"{where} cannot be read ({values}).") from values
    if not isinstance(values, dict):
        raise InputError(f"{where} is not a JSON object with a value for each column.")
    check_texts(values, where)
    row = read_row(values, where)
    for column, text in (("video", row.video), ("name", row.name or "")):
        if any(len(part.encode()) > _LONGEST_NAME for part in text.split("/")):
            raise InputError(f"{where}: column {column} has a name of {len(text)} characters; shorten it.")
    return row


def _json_lines(content: bytes) -> Iterator[tuple[int, Any]]:
    for number, line in enumerate(content.removeprefix(codecs.BOM_UTF8).splitlines(), 1):
        if line.strip():
            try:
                yield number, json.loads(line.decode())
            except ValueError as error:
                yield number, error
            except RecursionError:
                yield number, ValueError("it is too deeply nested")


def _csv(content: bytes) -> Iterator[tuple[int, Any]]:
    # What is not UTF-8 becomes a lone surrogate, which is found in the row where it is.
    text = content.decode("utf-8-sig", "surrogateescape")
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    columns = reader.fieldnames or ()
    if twice := next((name for name in columns if list(columns).count(name) > 1), None):
        raise ValueError(f"it has two columns {twice}; remove one")
    for values in reader:
        if values.pop(None, None):
            yield reader.line_num, ValueError("it has more values than there are columns")
        else:
            yield reader.line_num, values


def _parquet(content: bytes) -> Iterator[tuple[int, Any]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise InputError("Parquet tables need pyarrow: pip install 'tracking3d[export]'.") from error
    try:
        table = parquet.read_table(io.BytesIO(content))
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(str(error)) from error
    yield from enumerate(table.to_pylist(), 1)
