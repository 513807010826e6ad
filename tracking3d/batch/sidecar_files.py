"""Videos of a folder or a pattern, with prompts in files next to them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import PurePosixPath

from tracking3d.batch.rows import VideoRow, check_texts, read_row
from tracking3d.batch.storage import base, is_folder, join_path, matches, names_in, parent, read
from tracking3d.errors import InputError

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
