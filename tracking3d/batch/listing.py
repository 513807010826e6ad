"""The videos of a batch from a folder, a pattern, a table, or a dataset."""

from __future__ import annotations

import codecs
import csv
import io
import json
import os
import posixpath
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from tracking3d.batch.datasets import Dataset, dataset_reader
from tracking3d.batch.one_video import LOGS
from tracking3d.batch.rows import UnusableRow, VideoRow, check_texts, printable, read_row
from tracking3d.batch.storage import (
    absolute,
    base,
    is_folder,
    join_path,
    local,
    matches,
    names_in,
    parent,
    read,
)
from tracking3d.batch.video_job import VideoJob
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, Tracking3dError
from tracking3d.pipeline.validation import needs_prompt
from tracking3d.trackers.prompts.boxes import BoxFormat

Configure = Callable[[VideoRow], PipelineConfig]
"""Makes the pipeline of a row."""

NO_PROMPT = (
    "No prompt is given: put VIDEO.box (X,Y,W,H), VIDEO.json or a first-frame mask VIDEO.png next to the "
    "video, or add a column box, mask or points."
)


def list_jobs(
    place: str, configure: Configure, split: str = "", box_format: BoxFormat = "xywh"
) -> list[VideoJob]:
    """The videos of a folder, a pattern or a table.

    Rows of one video with the same settings are one job with several objects. What is wrong with one video is its
    fault, and stops no other.

    Args:
        place: What the user named.
        configure: Builds the pipeline of a row.
        split: Length of the parts that long videos are cut into, if a row does not give one; empty for none.
        box_format: How boxes are written, if a row does not say so.

    Raises:
        InputError: If there is nothing, no row of a table can be used, or two videos would have one name.
    """
    unusable: list[UnusableRow] = []
    if is_table(place):
        folder, root = absolute(parent(place)), ""
        rows = []
        for row in read_table(place):
            if isinstance(row, UnusableRow):
                unusable.append(row)
            else:
                rows.append((_absolute(row, folder), 0))
    else:
        root = absolute(place) if is_folder(place) else ""
        rows = [(_absolute(row, "."), size) for row, size in videos_of(place)]
    rows = _together(rows)
    names = _names([row for row, _ in rows], root)
    jobs = [_job(row, name, size, configure, split) for (row, size), name in zip(rows, names, strict=True)]
    jobs = [
        replace(job, box_format=row.box_format or box_format)
        for job, (row, _) in zip(jobs, rows, strict=True)
    ]
    return jobs + [_job_of_unusable(row, names) for row in unusable]


def dataset_jobs(dataset: Dataset, config: PipelineConfig) -> list[VideoJob]:
    """The sequences of a dataset, each with the box and the camera that it gives to a tracker."""
    return [_of_sequence(dataset, name, config) for name in dataset.sequences]


def _of_sequence(dataset: Dataset, name: str, config: PipelineConfig) -> VideoJob:
    root = str(dataset.root.absolute())
    layout = str(Path(dataset.layout).absolute()) if Path(dataset.layout).is_file() else dataset.layout
    job = VideoJob(name, join_name(root, name), config, sequence=(layout, root, name))
    try:
        truth = dataset_reader().read_sequence(layout, dataset.root, name)
        visible = truth.box_in_frame()
    except Tracking3dError as error:
        return replace(job, fault=str(error))
    if truth.box is None and needs_prompt(config):
        return replace(job, fault=f"{name} has no box in its first frame; a mask tracker cannot start.")
    camera, given = truth.given_camera or truth.camera, config.camera
    if camera is not None and truth.camera_told and given.intrinsics is None and given.fov is None:
        settings = given.model_copy(update={"intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy)})
        config = config.model_copy(update={"camera": settings})
    box = () if visible is None else (",".join(f"{value:.17g}" for value in visible),)
    size = sum(file.stat().st_size for file in truth.frames[:1]) * len(truth.frames)
    return replace(job, config=config, box=box, size=size)


def join_name(root: str, name: str) -> str:
    """A sequence of a dataset as messages call it."""
    return posixpath.join(root, name)


def _absolute(row: VideoRow, folder: str) -> VideoRow:
    """The row with places that mean the same everywhere."""
    update: dict[str, Any] = {
        "video": absolute(row.video, folder),
        "mask": tuple(absolute(one, folder) for one in row.mask),
        "masks": row.masks and absolute(row.masks, folder),
    }
    return row.model_copy(update=update)


def _together(rows: Sequence[tuple[VideoRow, int]]) -> list[tuple[VideoRow, int]]:
    """Rows that differ in the object only, as one."""
    groups: defaultdict[str, list[tuple[VideoRow, int]]] = defaultdict(list)
    for row, size in rows:
        # Not pydantic's JSON, which refuses paths that are not UTF-8.
        key = json.dumps(row.model_dump(exclude={"box", "mask", "points"}))
        groups[key].append((row, size))
    together = []
    for group in groups.values():
        objects: Mapping[str, Any] = {
            kind: tuple(one for row, _ in group for one in getattr(row, kind))
            for kind in ("box", "mask", "points")
        }
        together.append((group[0][0].model_copy(update=objects), group[0][1]))
    return together


def _names(rows: Sequence[VideoRow], root: str) -> list[str]:
    """What the run folders are called: after the video's place within ``root``, or within what all have in common.

    Raises:
        InputError: If two have the same name, or one leads out of the folder.
    """
    videos = [row.video for row in rows]
    if not root and videos:
        folders = {parent(video) for video in videos}
        alike = len({"://" in folder for folder in folders}) == 1
        root = os.path.commonpath(folders) if alike and len(folders) > 1 else min(folders, key=len)
    inside = [PurePosixPath(_within(video, root)) for video in videos]
    bare = Counter(path.with_suffix("") for path in inside)
    # A run folder within another one would be replaced with it.
    folders_of_others = {folder for path in inside for folder in path.parents} | {PurePosixPath(LOGS)}
    taken = {path for path, count in bare.items() if count > 1} | folders_of_others
    names = [
        row.name or str(path if path.with_suffix("") in taken else path.with_suffix(""))
        for row, path in zip(rows, inside, strict=True)
    ]
    seen: dict[str, str] = {}
    for name, video in zip(names, videos, strict=True):
        parts = PurePosixPath(name).parts
        if (
            not parts
            or parts == (LOGS,)
            or PurePosixPath(name).is_absolute()
            or any(part.startswith(".") for part in parts)
        ):
            raise InputError(
                f"The name '{name}' of {video} cannot be used for a run folder; choose another name."
            )
        if name in seen:
            raise InputError(
                f"{video} and {seen[name]} would both be written to {name}; add a column name with different names."
            )
        seen[name] = video
    if within := next(
        (name for name in names for one in PurePosixPath(name).parents if str(one) in seen), None
    ):
        raise InputError(
            f"The run folder {within} would lie inside another one; add a column name with another name."
        )
    return names


def _within(video: str, root: str) -> str:
    inside = video.removeprefix(root).lstrip("/") if video.startswith(root) else PurePosixPath(video).name
    # A pattern of images is called after the folder that they are in.
    path = PurePosixPath(inside)
    while any(sign in path.name for sign in "*?[") and len(path.parts) > 1:
        path = path.parent
    return "/".join(part.lstrip(".") or "_" for part in path.parts) or "video"


def _job_of_unusable(row: UnusableRow, names: Sequence[str]) -> VideoJob:
    name = f"line_{row.number}"
    while name in names:
        name += "_"
    return VideoJob(name, row.video, PipelineConfig(), fault=row.reason)


def _job(row: VideoRow, name: str, size: int, configure: Configure, split: str) -> VideoJob:
    fault = "" if row.has_prompt else NO_PROMPT
    try:
        config = configure(row)
    except Tracking3dError as error:
        config, fault = PipelineConfig(), str(error)
    except RecursionError:
        config, fault = PipelineConfig(), f"The settings of {row.video} are nested too deeply."
    if not fault and not size and (path := local(row.video)) is not None:
        with suppress(OSError):
            size = path.stat().st_size if path.is_file() else 0
    return VideoJob(
        name,
        row.video,
        config,
        row.box,
        row.mask,
        row.points,
        row.correct,
        row.start_frame,
        row.frames,
        size=size,
        fault="" if fault == NO_PROMPT and not needs_prompt(config) else fault,
        split=row.split or split,
    )


# fmt: off
VIDEOS = frozenset((
    ".3gp", ".avi", ".flv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg",
    ".mpg", ".mts", ".mxf", ".ogv", ".ts", ".webm", ".wmv", ".y4m",
))
# fmt: on
"""Names that count as videos in a folder."""

BOX, JSON = ".box", ".json"
MASKS = (".png", ".mask.png", ".jpg", ".mask.jpg")
"""Suffixes added to a video's name, with or without its own suffix, for the files with its prompts."""


def videos_of(place: str) -> list[tuple[VideoRow, int]]:
    """The videos of a folder and of folders within it, or those that a pattern names; and the bytes of each.

    A folder of images counts as a video if a file next to it gives its prompt.

    Raises:
        InputError: If there is none, or a file next to one is damaged.
    """
    if is_folder(place):
        sizes = names_in(place, everything=True)
        names = _videos_among(sizes)
        found = [(join_path(place, name), sizes.get(name, 0)) for name in names]
        beside = {join_path(place, name) for name in sizes}
    else:
        found = [(one, 0) for one in matches(place) if not _is_prompt(one)]
        folders = {parent(one) for one, _ in found}
        sizes = {
            join_path(folder, name): size for folder in folders for name, size in names_in(folder).items()
        }
        found = [(one, sizes.get(one, 0)) for one, _ in found]
        beside = set(sizes)
    if not found:
        raise InputError(
            f"{place} contains no video; give a folder with videos, or a pattern such as 'clips/*.mp4'."
        )
    return [(_with_prompt(video, beside), size) for video, size in found]


def _videos_among(names: Iterable[str]) -> list[str]:
    """Files with the suffix of a video, and folders of images with a sidecar file."""
    every = set(names)
    hidden = {name for name in every if any(part.startswith(".") for part in name.split("/"))}
    files = {name for name in every - hidden if PurePosixPath(name).suffix.lower() in VIDEOS}
    folders = {str(PurePosixPath(name).parent) for name in every - hidden} - {"."}
    return sorted(files | {folder for folder in folders if any(f"{folder}{end}" in every for end in _ends())})


def _is_prompt(place: str) -> bool:
    return place.endswith(_ends()) or base(place).startswith(".")


def _ends() -> tuple[str, ...]:
    return (BOX, JSON, *MASKS)


def _with_prompt(video: str, beside: set[str]) -> VideoRow:
    """The row of a video from its sidecar files; without a prompt if there is none."""
    stems = [video, video.removesuffix(PurePosixPath(base(video)).suffix)]
    for stem in stems:
        if (file := stem + JSON) in beside:
            return _from_json(file, video)
        if (file := stem + BOX) in beside:
            text = (read(file) or b"").decode("utf-8", "replace")
            boxes = [line.strip() for line in text.splitlines() if line.strip()]
            return read_row({"video": video, "box": boxes}, file)
        for end in MASKS:
            if (file := stem + end) in beside and file != video:
                return read_row({"video": video, "mask": [file]}, file)
    return VideoRow(video=video)


def _from_json(file: str, video: str) -> VideoRow:
    try:
        values = json.loads(read(file) or b"")
        if not isinstance(values, dict):
            raise ValueError("it is not a JSON object")
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{file} cannot be read ({error}); it must hold the same keys as a row of a table."
        ) from error
    check_texts(values, file)
    return read_row({**values, "video": video}, file)


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
