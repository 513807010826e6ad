"""Exporting a run: checks of options and paths; an export is written completely or not at all."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.config.camera import check_object_size
from tracking3d.config.explain import nearest
from tracking3d.errors import InputError, OutputError, argument
from tracking3d.export.formats import FORMATS, Exporter
from tracking3d.export.options import ExportOptions
from tracking3d.results.layout import ARBITRARY, EXPORT, OVERWRITE, check_run_folder, partial_path, run_files
from tracking3d.runtime.progress import report_progress

if TYPE_CHECKING:
    from tracking3d.export.exported_run import ExportedRun
    from tracking3d.results.run_reader import RunReader

FOLDER = EXPORT
"""Default folder of exports, in the run folder."""
LABEL = "export.json"
"""Name of a file in every exported folder that describes the export and allows replacing it."""
_FORMAT = "tracking3d-export"
_END_OF_TIME = 2.0**31
"""Seconds from 1970 that a stamp of ROS can hold."""
_OUT = argument("out=", "--out")
_TO = argument("to=", "--to")
_NAMED = {
    one.name: argument(f"{one.name}=", f"--{one.name.replace('_', '-')}") for one in fields(ExportOptions)
} | {"images": argument("images=", "--no-images")}


@dataclass(frozen=True)
class Export:
    """What was exported."""

    path: Path  # the file or folder
    unit: str | None  # the unit of lengths, in words; None if the format has none
    frames: int  # how many frames have what the format is about, a pose or a mask; of a model, those it is of
    # frames between the first and the last that have none: skipped, and of poses, lost
    without: tuple[int, ...]
    not_finished: str = ""  # a sentence about a run that has not come to its end; empty for one that has
    of_model: bool = False  # whether it is the model and nothing of single frames
    # what to know, in sentences: images that are left out, a video that was given in vain, a rotation that is not known
    note: str = ""

    @property
    def in_words(self) -> str:
        """The number of frames, unless only the model was exported, and the unit if it is arbitrary."""
        left_out = f", {len(self.without)} without an estimate" if self.without else ""
        unit = ", lengths in the arbitrary unit of the run" if self.unit == ARBITRARY else ""
        return f"the model{unit}" if self.of_model else f"{self.frames} frames{left_out}{unit}"


def find_format(name: str) -> Exporter:
    """The format of that name.

    Raises:
        InputError: If there is none; names those that there are.
    """
    if name in FORMATS:
        return FORMATS[name]
    known = f"{_TO} takes {', '.join(FORMATS)}"
    if similar := similar_formats(name, FORMATS):
        raise InputError(f"There is no format {name} ({known}); did you mean {' or '.join(similar)}?")
    raise InputError(f"There is no format {name}; {known}.")


def export_run(
    run: Path | str,
    to: str,
    out: Path | str | None = None,
    *,
    options: ExportOptions | None = None,
    overwrite: bool = False,
) -> Export:
    """Write a run in the format of another tool.

    Args:
        run: The run folder.
        to: Name of the format, see `tracking3d.export.formats.FORMATS`.
        out: The file or folder to write; None takes one in the folder ``export`` of the run.
        options: What else is asked; None asks nothing.
        overwrite: Whether an earlier file, or folder that was exported, is replaced.

    Raises:
        InputError: If the run, the format or an option cannot be used.
        OutputError: If something is there already, or cannot be written.
    """
    options = options or ExportOptions()
    exporter = find_format(to)
    exporter.check_options(options, _NAMED)
    _check(options)
    exporter.check_available()
    check_run_folder(Path(run))
    # Only now, because they need seconds to import.
    from tracking3d.estimation.estimate import FREE_ROTATION
    from tracking3d.export.exported_run import ExportedRun
    from tracking3d.results.run_reader import RunReader

    reader = RunReader(Path(run), refined=options.answers == "final")
    options, note = _without_video(exporter, options, reader)
    exported = ExportedRun(reader, options)
    if exporter.kind not in ("masks", "model", "probabilities") and exported.free_axis:
        note = " ".join(filter(None, (note, f"{FREE_ROTATION.capitalize()}.")))
    path = reader.folder / FOLDER / exporter.default_name(exported) if out is None else Path(out).resolve()
    _check_place(path, exporter, overwrite)
    if path in (file.resolve() for file in run_files(reader.folder)):
        raise OutputError(f"{path} is a file of the run itself; choose another {_OUT}.")
    answered = _frames_with_estimates(exporter, exported)
    without = tuple(index for index in exported.span if index not in answered)
    report_progress(f"writing {exporter.name}")
    with _replace_when_done(path) as place:
        exporter.write(exported, place)
        if place.is_dir():
            label = _label(exporter, exported, without) | ({"note": note} if note else {})
            (place / LABEL).write_text(json.dumps(label, indent=1) + "\n", encoding="utf-8")
    unit = exported.unit if "object_size" in exporter.options else None
    given = path if out is None else Path(out)
    return Export(given, unit, len(answered), without, reader.not_finished, exporter.kind == "model", note)


def _without_video(exporter: Exporter, options: ExportOptions, run: RunReader) -> tuple[ExportOptions, str]:
    """The options, without images if the format can do without them and the video is gone, and what to say of it."""
    from tracking3d.results.run_reader import open_run_source

    named = "The source that was given"
    if "images" not in exporter.options:
        lost = options.source is not None and not Path(options.source).exists()
        return (
            options,
            f"{named}, {options.source}, does not exist; the export does without it." if lost else "",
        )
    if not options.images:
        return options, f"{named} is not used without images." if options.source is not None else ""
    try:
        open_run_source(run, options.source)
    except InputError as error:
        if options.source is None:
            return replace(options, images=False), f"The images are left out. {error}"
    return options, ""


def _check(options: ExportOptions) -> None:
    check_object_size(options.object_size)
    if options.fps is not None and not 0 < options.fps < float("inf"):
        raise InputError(f"{_NAMED['fps']} is {options.fps:g}; give a number above 0.")
    if options.start_time is not None and not 0 < options.start_time < _END_OF_TIME:
        raise InputError(
            f"{_NAMED['start_time']} is {options.start_time:g}; give seconds from 1970 above 0 and before 2038, "
            "the end of ROS's clock."
        )
    if options.answers not in ("final", "causal"):
        raise InputError(f"Estimates cannot be '{options.answers}'; choose final or causal.")
    if options.of not in ("object", "camera"):
        raise InputError(f"Poses cannot be of '{options.of}'; {_NAMED['of']} must be object or camera.")
    if options.unseen not in ("close", "cut"):
        raise InputError(f"'{options.unseen}' is no value of {_NAMED['unseen']}; it must be close or cut.")


def _frames_with_estimates(exporter: Exporter, run: ExportedRun) -> set[int]:
    """The frames that have what the format is about."""
    if exporter.kind in ("masks", "model"):
        return set(run.records)
    return set(run.with_probability) if exporter.kind == "probabilities" else {one.index for one in run.poses}


def _label(exporter: Exporter, run: ExportedRun, without: tuple[int, ...]) -> dict[str, object]:
    """Description of the export for readers of the folder."""
    return {
        "format": _FORMAT,
        "to": exporter.name,
        "run": str(run.reader.folder.resolve()),
        "answers": run.options.answers,
        "unit": run.unit,
        "frames_without_answer": without,
    }


def _check_place(path: Path, exporter: Exporter, overwrite: bool) -> None:
    """Make sure that nothing is lost at ``path``."""
    if not path.exists():
        return
    is_folder = path.is_dir()
    if is_folder and not any(path.iterdir()) and not exporter.suffix:
        return
    if is_folder != (not exporter.suffix):
        kinds = ("file", "folder") if exporter.suffix else ("folder", "file")
        raise OutputError(
            f"{path} is a {kinds[1]}, and {exporter.name} is a {kinds[0]}; choose another {_OUT}."
        )
    if not overwrite:
        raise OutputError(f"{path} already exists; choose another {_OUT} or pass {OVERWRITE}.")
    if is_folder and not _is_export(path):
        raise OutputError(f"{path} holds files that are not an export; choose another {_OUT}.")


def _is_export(folder: Path) -> bool:
    try:
        label = json.loads((folder / LABEL).read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(label, dict) and label.get("format") == _FORMAT


@contextmanager
def _replace_when_done(path: Path) -> Iterator[Path]:
    """A path of the same name in a folder next to ``path``; what is there at a good end replaces ``path``."""
    from tracking3d.results.files import writing

    workshop = partial_path(path)
    made, earlier = workshop / path.name, workshop / "earlier"
    with writing(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if earlier.is_dir() and not path.exists():  # killed at the worst moment
                earlier.rename(path)
            _remove(workshop)
            workshop.mkdir()
            yield made
            if path.is_dir():  # a rename does not replace a folder
                path.rename(earlier)
            made.replace(path)
        finally:
            if earlier.is_dir() and not path.exists():
                earlier.rename(path)
            _remove(workshop)


def _remove(folder: Path) -> None:
    if folder.is_dir():
        shutil.rmtree(folder)


# fmt: off
OTHER_NAMES = {
    **dict.fromkeys(("usd", "usda", "usdc"), ("usdz",)),
    **dict.fromkeys(("ros", "ros2", "rosbag", "bag", "db3"), ("ros-bag",)),
    **dict.fromkeys(("fbx", "abc", "alembic"), ("animated-glb", "usdz")),
    **dict.fromkeys(("ae", "jsx"), ("after-effects",)),
    **dict.fromkeys(("mp4", "video"), ("vp9", "prores")),
    **dict.fromkeys(("nerf", "instant-ngp"), ("nerfstudio",)),
    **dict.fromkeys(("gaussian-splatting", "3dgs"), ("colmap",)),
    "gltf": ("glb", "animated-glb"), "obj": ("glb", "nuke"), "mesh": ("glb", "ply", "stl"),
    "chan": ("nuke",), "blend": ("blender",), "rrd": ("rerun",), "mov": ("prores",), "webm": ("vp9",),
    "png": ("davis", "cut-outs"), "masks": ("davis", "coco", "vot"), "json": ("coco", "nerfstudio"),
    "trajectory": ("tum", "kitti"), "txt": ("tum",), "poses": ("csv", "tum", "bop"),
    "points": ("points-csv", "tapvid"), "npz": ("tapvid",),
}
# fmt: on
"""By name in small letters, without a dot before it."""


def similar_formats(name: str, formats: Iterable[str]) -> list[str]:
    """The formats that are likely meant by ``name``, which is none of them; none if nothing comes close."""
    known = list(formats)
    if meant := [one for one in OTHER_NAMES.get(name.lower().lstrip("."), ()) if one in known]:
        return meant
    best = nearest(name, known)
    return [] if best is None else [best]
