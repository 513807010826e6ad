"""Files that ``--box`` and ``--mask`` name, and what ``--object`` excludes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.cli.options.prompt import PromptOptions
    from tracking3d.config.models import PipelineConfig
    from tracking3d.frames import Box
    from tracking3d.prompts.boxes import BoxFormat

_ALL = "@all"


def parse_given_box(text: str, frame: int, box_format: BoxFormat = "xywh") -> Box:
    """Read a box, or the box of frame ``frame`` in a file in VOT's region format.

    Args:
        text: Four numbers, or the path of the file.
        frame: Index of the frame.
        box_format: What the four numbers are.

    Raises:
        InputError: The text is neither.
    """
    from tracking3d.prompts.boxes import parse_box

    if Path(text).is_file():
        from tracking3d.trackers.region_masks import box_in_file

        return box_in_file(Path(text), frame, f"--box {text}")
    return parse_box(text, box_format=box_format)


def parse_given_masks(file: Path) -> list[Path]:
    """The file itself, or ``FILE@N`` for every object of an indexed image ``FILE@all``.

    Raises:
        InputError: The file does not exist, or the image shows no object.
    """
    from tracking3d.trackers.mask_images import objects_in, split_object

    name = str(file)
    if not name.endswith(_ALL) or file.exists():
        if not split_object(file)[0].is_file():
            raise InputError(f"--mask {file} does not exist.")
        return [file]
    image = Path(name.removesuffix(_ALL))
    if not image.is_file():
        raise InputError(f"--mask {image} does not exist.")
    numbers = objects_in(image)
    if not numbers:
        raise InputError(f"--mask {name} is empty; give each object a value from 1 upwards.")
    return [Path(f"{image}@{number}") for number in numbers]


def check_files(prompt: PromptOptions, prototype: str | None) -> None:
    """Make sure that what ``--masks``, ``--object`` and ``--prototype`` name exists, before anything reads it.

    Raises:
        InputError: One does not.
    """
    from tracking3d.trackers.mask_images import split_object

    if prompt.masks is not None and not split_object(prompt.masks)[0].exists():
        raise InputError(
            f"--masks {prompt.masks} does not exist; give a folder, a video, an .npz or an .npy file, COCO's .json or "
            "VOT's .txt."
        )
    if prompt.known is not None and not Path(prompt.known).expanduser().exists():
        raise InputError(
            f"--object {prompt.known} does not exist; give the folder of an earlier run, or a mesh file."
        )
    if prompt.extend and (prompt.known is None or not Path(prompt.known).expanduser().is_dir()):
        raise InputError(
            "--extend needs the folder of an earlier run of the same object: give it by --object RUN."
        )
    if prototype not in (None, "sphere", "ellipsoid") and not Path(str(prototype)).exists():
        raise InputError(
            f"The prototype '{prototype}' does not exist; give sphere, ellipsoid or a mesh file."
        )


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


def check_extended(settings: PipelineConfig, objects: int, split: bool) -> None:
    """Make sure that the other options go with ``--extend``, and that the earlier run has a model.

    Raises:
        InputError: One of them does not, or it has none.
    """
    if settings.object.extends is None:
        return
    from tracking3d.pipeline.known_object import read_known_object
    from tracking3d.reconstruction.extension import check_earlier_run
    from tracking3d.reconstruction.rebuild import check_packages

    if objects > 1 or split:
        raise InputError(
            "--extend makes one model of one object; give one box or mask, and leave out --split."
        )
    check_packages()
    earlier = Path(settings.object.extends)
    if not earlier.is_dir():
        raise InputError(f"{earlier} is not the folder of an earlier run; give one by --object RUN --extend.")
    read_known_object(earlier)
    check_earlier_run(earlier)
