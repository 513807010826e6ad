"""Reading results of any method: the format is recognized from the contents of a file or folder."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from tracking3d.config.explain import format_value, hint
from tracking3d.errors import InputError
from tracking3d.video.image_sequence import images_among
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.readers.bop_csv import answers_from_bop_csv
from tracking3d_bench.datasets.readers.colmap import answers_from_colmap
from tracking3d_bench.datasets.readers.masks import answers_from_masks
from tracking3d_bench.datasets.readers.tapvid import answers_from_tapvid
from tracking3d_bench.datasets.readers.tum import answers_from_tum
from tracking3d_bench.datasets.truth import Truth


@dataclass(frozen=True)
class AnswerFormat:
    """A format of results.

    Attributes:
        title: What messages call it.
        read: Reads ``(path, truth, **options)``.
    """

    title: str
    read: Callable[..., Answers]


ANSWER_FORMATS = {
    "masks": AnswerFormat("mask images", answers_from_masks),
    "bop": AnswerFormat("poses of the BOP Challenge", answers_from_bop_csv),
    "tum": AnswerFormat("a TUM trajectory", answers_from_tum),
    "tapvid": AnswerFormat("TAP-Vid point tracks", answers_from_tapvid),
    "colmap": AnswerFormat("a COLMAP model", answers_from_colmap),
}
"""By the name that ``format`` selects."""


def read_answers(path: Path, truth: Truth, format: str | None = None, **options: Any) -> tuple[Answers, str]:
    """Read the results of any method for a clip.

    Args:
        path: File or folder.
        truth: The clip.
        format: One of `ANSWER_FORMATS`; recognised if None.
        options: Options of that format's function, such as ``object_id`` or ``of``.

    Returns:
        The estimates, and what they were read as, in words.

    Raises:
        InputError: If the format is unknown or not recognised, has no such option, or the results cannot be read.
    """
    name = recognise_format(path) if format is None else format
    if name not in ANSWER_FORMATS:
        raise InputError(
            f"There is no format '{name}' (known are {', '.join(ANSWER_FORMATS)}); {hint(name, ANSWER_FORMATS)}"
        )
    known = ANSWER_FORMATS[name]
    return known.read(path, truth, **_checked(options, path, known)), known.title


def _checked(options: Mapping[str, Any], path: Path, known: AnswerFormat) -> dict[str, Any]:
    """The options, each of the type that the format's function takes; several numbers may be a text with commas."""
    hints = get_type_hints(known.read)
    kinds = {name: hints[name] for name in list(inspect.signature(known.read).parameters)[2:]}
    checked = {}
    for name, value in options.items():
        if name not in kinds:
            raise InputError(
                f"{path} is {known.title}, which has no such option ({name}); {hint(name, kinds)}"
            )
        spellings = [value, value.split(",")] if isinstance(value, str) and "," in value else [value]
        try:
            checked[name] = _first_valid(TypeAdapter(kinds[name]), spellings)
        except ValidationError as error:
            wanted = error.errors()[0]["msg"].removeprefix("Input should be ")
            raise InputError(
                f"The option {name} of {known.title} cannot be {format_value(value)}: it must be {wanted}."
            ) from error
    return checked


def _first_valid(kind: TypeAdapter[Any], spellings: list[Any]) -> Any:
    """The first of ``spellings`` that is of that type; raises pydantic's error about the last if none is."""
    for value in spellings[:-1]:
        with suppress(ValidationError):
            return kind.validate_python(value)
    return kind.validate_python(spellings[-1])


def recognise_format(path: Path) -> str:
    """The name in `ANSWER_FORMATS` of what ``path`` holds.

    A folder with ``images.bin`` or ``images.txt``, in it or a folder below, is COLMAP's, and one with images holds
    masks; of files, ``.csv`` is BOP's, ``.txt`` and ``.tum`` are trajectories, ``.pkl``, ``.pickle`` and ``.npz`` are
    point tracks.

    Raises:
        InputError: If it is nothing of these.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path.")
    if path.is_dir():
        if any(
            next(path.glob(f"{below}images.{suffix}"), None) for below in _BELOW for suffix in ("bin", "txt")
        ):
            return "colmap"
        if images_among(path.iterdir()) or any(
            images_among(folder.iterdir()) for folder in path.iterdir() if folder.is_dir()
        ):
            return "masks"
    elif path.suffix.lower() in _SUFFIXES:
        return _SUFFIXES[path.suffix.lower()]
    raise InputError(f"The format of {path} is not recognized; choose one of {', '.join(ANSWER_FORMATS)}.")


_BELOW = ("", "*/", "sparse/*/")

_SUFFIXES = {
    ".csv": "bop",
    ".txt": "tum",
    ".tum": "tum",
    ".pkl": "tapvid",
    ".pickle": "tapvid",
    ".npz": "tapvid",
}
