"""Videos of a folder or a pattern, with what is tracked in them said by files beside them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import PurePosixPath

from tracking3d.batch.places import base, is_folder, join_path, matches, names_in, parent, read
from tracking3d.batch.rows import VideoRow, read_row
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
"""What is added to a video's name, with its suffix or without, for the files that say what is tracked in it."""


def videos_of(place: str) -> list[tuple[VideoRow, int]]:
    """The videos of a folder and of folders within it, or those that a pattern names; and the bytes of each.

    A folder of images counts as a video where a file beside it says what is tracked in it.

    Raises:
        InputError: If there is none, or a file beside one is damaged.
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
            f"{place} names no video; give a folder that has some, or a pattern such as 'clips/*.mp4'."
        )
    return [(_with_prompt(video, beside), size) for video, size in found]


def _videos_among(names: Iterable[str]) -> list[str]:
    """Files that are called as videos are, and folders of images that something is said of."""
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
    """The row that the files beside a video make; one without a prompt where there is none."""
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
            raise ValueError("it holds no object")
    except ValueError as error:
        raise InputError(f"{file} cannot be read ({error}); it holds what a row of a table does.") from error
    return read_row({**values, "video": video}, file)
