"""What ``--box``, ``--mask`` and ``--object`` say of the objects, where they name files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.frames import Box

_ALL = "@all"


def given_box(text: str, frame: int) -> Box:
    """``X,Y,WIDTH,HEIGHT``, or that of frame ``frame`` in a file of VOT's regions.

    Raises:
        InputError: If it is neither.
    """
    from tracking3d.prompts import parse_box
    from tracking3d.trackers.region_masks import box_in_file

    if Path(text).is_file():
        return box_in_file(Path(text), frame, f"--box {text}")
    return parse_box(text)


def given_masks(file: Path) -> list[Path]:
    """The file, or ``FILE@N`` for every object of an indexed image ``FILE@all``.

    Raises:
        InputError: If there is no object in it.
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
        raise InputError(f"--mask {name} is empty; mark the objects in it by numbers from 1.")
    return [Path(f"{image}@{number}") for number in numbers]


def check_object_options(settings: PipelineConfig, objects: int, fine: bool, split: bool) -> None:
    """Make sure of what is asked for beside ``--object``.

    Raises:
        InputError: If it does not go together.
    """
    if settings.object.known is None:
        return
    from tracking3d.arguments import check_single_known_object as check_one

    check_one(settings, objects)
    if fine:
        raise InputError(
            "The shape of an object that is known is held; leave out --model fine, or --object for a new one."
        )
    if split:
        raise InputError("--split joins parts that each get to know the object; leave it out with --object.")
