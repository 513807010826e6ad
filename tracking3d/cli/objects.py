"""Files that ``--box`` and ``--mask`` name, and what ``--object`` excludes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.frames import Box

_ALL = "@all"


def parse_given_box(text: str, frame: int) -> Box:
    """Read ``X,Y,WIDTH,HEIGHT``, or the box of frame ``frame`` in a file in VOT's region format.

    Raises:
        InputError: The text is neither.
    """
    from tracking3d.prompts.prompt import parse_box
    from tracking3d.trackers.region_masks import box_in_file

    if Path(text).is_file():
        return box_in_file(Path(text), frame, f"--box {text}")
    return parse_box(text)


def parse_given_masks(file: Path) -> list[Path]:
    """The file itself, or ``FILE@N`` for every object of an indexed image ``FILE@all``.

    Raises:
        InputError: The image shows no object.
    """
    from tracking3d.trackers.mask_images import objects_in

    name = str(file)
    if not name.endswith(_ALL) or file.exists():
        return [file]
    image = Path(name.removesuffix(_ALL))
    if not image.is_file():
        raise InputError(f"--mask {image} does not exist.")
    numbers = objects_in(image)
    if not numbers:
        raise InputError(f"--mask {name} is empty; give each object a value from 1 upwards.")
    return [Path(f"{image}@{number}") for number in numbers]


def check_known(settings: PipelineConfig, objects: int, split: bool) -> None:
    """Make sure that the other options go with ``--object``.

    Raises:
        InputError: One of them does not.
    """
    if settings.object.model is None:
        return
    from tracking3d.pipeline.validation import check_single_known_object as check_one

    check_one(settings, objects)
    if split:
        raise InputError(
            "--split merges parts that each reconstruct the object; leave out --split, or --object."
        )
