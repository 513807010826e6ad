"""The layout of a data set: its description, a short YAML file.

All paths are relative to the data set's folder and may be glob patterns. ``{sequence}`` and ``{object}`` in them
stand for the sequence and the object that are read, ``{frame}`` and ``{instance}`` for the number of a frame and
of the object in that frame's list; numbers may be given digits, as in ``{frame:06d}``.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, field_validator, model_validator

from tracking3d.config.explain import describe_validation_error, hint
from tracking3d.config.loading import read_mapping
from tracking3d.config.models import Section
from tracking3d.errors import InputError

PLACEHOLDERS = frozenset(("sequence", "object", "frame", "instance"))


def _validate_path(path: str) -> str:
    try:
        named = {name for _, name, _, _ in Formatter().parse(path) if name is not None}
    except ValueError as error:
        raise ValueError("a brace without its partner") from error
    if named - PLACEHOLDERS:
        raise ValueError("braces may hold sequence, object, frame or instance only")
    pure = PurePosixPath(path)
    if pure.is_absolute() or ".." in pure.parts or not pure.parts:
        raise ValueError("a path must lie below the data set's folder")
    return path


Pattern = Annotated[str, AfterValidator(_validate_path)]
Patterns = Annotated[
    tuple[Pattern, ...],
    BeforeValidator(lambda value: (value,) if isinstance(value, str) else value),
    Field(min_length=1),
]
"""One pattern, or several, of which the first that matches is used."""


class Sequences(Section):
    """What the sequences are."""

    folders: Pattern = Field(
        "*", description="Pattern of their folders; each folder's path is a sequence's name."
    )
    inside: str = Field(".", description="Parent of these folders, if it is not part of their names.")
    holding: Patterns | None = Field(
        None, description="Only folders that contain a match of one of these patterns are sequences."
    )
    list: Patterns | None = Field(
        None, description="Text file with one name per line; if it is missing, the folders are listed."
    )


class MaskLayout(Section):
    """Images of masks."""

    files: Patterns = Field(description="Pattern of the images; with {frame}, the image of each frame.")
    values: Literal["threshold", "nonzero", "objects"] | int | tuple[int, int, int] = Field(
        "threshold",
        description="Object pixels: brighter than half, not 0, the label {object}, one label, or one colour.",
    )


class Regions(Section):
    """A text file with a region a line, for one frame after the other."""

    file: Patterns
    form: Literal["vot", "xywh", "xyxy", "polygon"] = Field(
        "vot", description="vot detects the form of each line: rectangle, polygon or encoded mask."
    )
    score: Literal["box", "mask"] = Field(
        "box",
        description="Compare the estimate's bounding box with the rectangle, or its mask with the filled rectangle.",
    )
    zero: Literal["absent", "unknown"] = Field(
        "absent", description="Meaning of the codes 0 and NaN: object not visible, or not annotated."
    )
    header_lines: int = Field(0, ge=0, description="Number of header lines to skip.")
    frame_column: int | None = Field(
        None,
        ge=0,
        description="Column, from 0, of the frame number as in its name; else line n is frame n.",
    )
    first_column: int = Field(0, ge=0, description="First column, from 0, of the region.")
    one_based: bool = Field(False, description="Whether the first pixel has the coordinate 1.")


class Poses(Section):
    """Poses of the object."""

    file: Patterns = Field(description="The file; with form matrices, the files of all frames.")
    form: Literal["clip", "bop", "matrices", "lines"] = Field(
        "clip",
        description="poses.json, scene_gt.json, a text file of 3 x 4 or 4 x 4 numbers per frame, or a line each.",
    )
    inverse: bool = Field(False, description="Whether the matrices are T_obj_cam.")


class Intrinsics(Section):
    """The camera: a file, or fx, fy, cx, cy."""

    file: Patterns | None = None
    form: Literal["json", "text", "bop"] = Field(
        "json", description="K or fx, fy, cx, cy by key; 4 or 9 or more numbers; scene_camera.json."
    )
    values: tuple[float, float, float, float] | None = Field(None, description="fx, fy, cx, cy in pixels.")

    @model_validator(mode="after")
    def _one_of_both(self) -> Intrinsics:
        if (self.file is None) == (self.values is None):
            raise ValueError("either file or values must be given")
        return self


class Depth(Section):
    """16-bit images of depth."""

    files: Patterns
    scale: float | None = Field(
        None,
        gt=0,
        description="Unit of the poses per count; else that of scene_camera.json, or a millimetre.",
    )


class ShapeLayout(Section):
    """The true mesh."""

    file: Patterns
    scale: float = Field(1.0, gt=0, description="Unit of the poses per unit of the file.")


class Symmetries(Section):
    """Transforms that leave the object as it is: models_info.json of BOP, or matrices."""

    file: Patterns | None = None
    values: tuple[tuple[float, ...], ...] = Field((), description="4 x 4 numbers each, row by row.")


class DatasetLayout(Section):
    """A data set's description."""

    name: str
    title: str
    link: str = ""
    licence: str = ""
    note: str = ""
    clips: bool = Field(
        False,
        description="Whether each sequence is a clip as written by `tracking3d demo`; then no other key is needed.",
    )
    sequences: Sequences = Sequences()
    frames: Patterns = ("{sequence}/frames/*",)
    objects: Literal["one", "masks", "poses"] | Pattern = Field(
        "one",
        description="Objects: only one, the labels of the first mask, scene_gt.json, or a pattern with {object}.",
    )
    match: Literal["number", "name", "order"] = Field(
        "number",
        description="How files are matched to frames: by the last number in their names, by name, or by order.",
    )
    every: int = Field(1, ge=1, description="With order: file n belongs to frame n times this.")
    masks: MaskLayout | None = Field(None, description="The whole object if known.")
    visible_masks: MaskLayout | None = Field(None, description="What is seen of it.")
    initial_masks: MaskLayout | None = Field(None, description="Rough masks, a tracker's input.")
    regions: Regions | None = None
    box: Regions | None = Field(None, description="File whose first line is the object in the first frame.")
    poses: Poses | None = None
    camera: Intrinsics | None = None
    depth: Depth | None = None
    mesh: ShapeLayout | None = None
    symmetries: Symmetries | None = None
    millimetres: float | None = Field(None, gt=0, description="Length of the unit of the poses.")

    @field_validator("objects")
    @classmethod
    def _names_objects(cls, value: str) -> str:
        if value not in ("one", "masks", "poses") and "{object}" not in value:
            raise ValueError("one, masks, poses, or a path with {object} in it")
        return value


def load_layout(layout: str | Path) -> DatasetLayout:
    """Read a description.

    Args:
        layout: Name of a built-in one, or a YAML file.

    Raises:
        InputError: If there is no such description, or a key or value in it cannot be used.
    """
    names = builtin_layouts()
    if str(layout) in names:
        with resources.as_file(_folder() / f"{layout}.yaml") as file:
            return _read(file)
    file = Path(layout)
    if not file.is_file():
        raise InputError(
            f"There is no data set '{layout}'; give a YAML file or one of {', '.join(names)}: "
            f"{hint(str(layout), names)}"
        )
    return _read(file)


def builtin_layouts() -> list[str]:
    """Names of the descriptions that come with the package."""
    return sorted(Path(item.name).stem for item in _folder().iterdir() if item.name.endswith(".yaml"))


def _folder() -> Any:
    return resources.files("tracking3d_bench.datasets") / "layouts"


def _read(file: Path) -> DatasetLayout:
    try:
        return DatasetLayout.model_validate(read_mapping(file))
    except ValidationError as error:
        raise InputError(f"{file}: {describe_validation_error(error, DatasetLayout, 'key')}") from error
