"""``tracking3d run``: track an object through a video and write a run folder."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from tracking3d.cli.model import check_model_source
from tracking3d.cli.options import Debug, Quiet, SettingsOptions, grouped
from tracking3d.cli.options.general import settings_of
from tracking3d.cli.options.output import OutputOptions, PerformanceOptions
from tracking3d.cli.options.prompt import PromptOptions
from tracking3d.cli.options.tracking import CameraOptions, Source, TrackingOptions, VideoOptions
from tracking3d.cli.pick import open_picker, settings_menu, track_picked
from tracking3d.cli.tracking import RunDisplay, RunRequest, a_person_is_there, default_folder, track
from tracking3d.errors import InputError
from tracking3d.runtime.memory import collection_deferred

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.frames import Box
    from tracking3d.pipeline.submaps.job import SplitResult
    from tracking3d.trackers.prompts.boxes import BoxFormat
    from tracking3d.trackers.prompts.corrections import Correction
    from tracking3d.trackers.prompts.prompt import PromptSet


@grouped
def run(
    source: Source,
    prompt: PromptOptions,
    video: VideoOptions,
    camera: CameraOptions,
    tracking: TrackingOptions,
    settings: SettingsOptions,
    output: OutputOptions,
    performance: PerformanceOptions,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Track the object through SOURCE: masks, poses and a textured mesh in a run folder.

    Give the object with --box, --mask, --points, --masks or --object. Each box, mask or --points is an object with a
    run folder of its own.
    """
    # All that can be checked before what tracks is imported, which takes seconds.
    from tracking3d.cli.progress import load_with_progress, show_progress
    from tracking3d.pipeline.validation import needs_prompt
    from tracking3d.video.addresses import check_source_name
    from tracking3d.video.opening import validate_fps

    prompt = prompt.completed_from(settings.config)
    output.check()
    performance.check()
    check_source_name(source)
    validate_fps(video.fps)
    check_files(prompt, tracking.prototype)
    if prompt.known is not None and not prompt.extend and output.object_size is not None:
        raise InputError("A known object has its own unit; leave out --object-size, or --object.")
    prompts = _parse_prompts(prompt, video.frames)
    corrections = _parse_corrections(prompt, len(prompts))
    with show_progress(quiet), collection_deferred():  # plug-ins are imported to check their options
        config = _configure(prompt, camera, tracking, settings, output, performance)
    check_model_source(settings.model, source)
    folder = output.out or default_folder(source)
    check_known(config, len(prompts), performance.split is not None)
    check_extended(config, len(prompts), performance.split is not None)
    if (
        not prompts
        and needs_prompt(config)
        and config.tracker.name == "auto"
        and _holds_cut_outs(source, quiet)
    ):
        prompt = replace(prompt, masks=Path(source))
        config = _configure(prompt, camera, tracking, settings, output, performance)
    asks = not prompts and needs_prompt(config)
    if asks and (not a_person_is_there() or quiet or output.resume or source.isdigit()):
        raise InputError(
            "Give the object in the first frame with --box X,Y,W,H, --mask FILE, --points 'X,Y+ X,Y-' or --masks DIR, "
            "or draw it with `tracking3d pick`."
        )
    load_with_progress("tracking3d.pipeline.record", quiet, kernels=not asks)
    from tracking3d.pipeline.record import RecordOptions

    options = RecordOptions(_command(), video.frames, output.overwrite, output.resume)
    request = RunRequest(source, config, folder, prompts, options, corrections, video.skip_damaged, video.fps)
    display = RunDisplay(quiet, output.report, output.view, output.host)
    split = performance.split
    start = track if split is None else partial(track_in_parts, length=split, workers=performance.workers)
    if not asks:
        return start(request, display)
    configure = partial(_configure_in_browser, prompt, output, performance)
    menu = settings_menu(source, video.frames, tracking, camera, settings, configure)
    typer.echo("Mark the object in the browser; Ctrl-C cancels.", err=True)
    with closing(open_picker(request, menu)) as page:
        track_picked(page, request, display, start)


def _holds_cut_outs(source: str, quiet: bool) -> bool:
    """Whether the images' alpha says where the object is, and a note that it does."""
    from tracking3d.trackers.mask_files import holds_cut_outs

    found = holds_cut_outs(source)
    if found and not quiet:
        typer.echo(
            f"The alpha of the images in {source} is taken as the object's masks; to have it tracked instead, give "
            "--tracker, --box, --mask, --points or --masks.",
            err=True,
        )
    return found


def _configure(
    prompt: PromptOptions,
    camera: CameraOptions,
    tracking: TrackingOptions,
    settings: SettingsOptions,
    output: OutputOptions,
    performance: PerformanceOptions,
) -> PipelineConfig:
    """The configuration that the options make together."""
    given = settings_of(tracking, output, performance)
    given |= {"tracker": tracking.tracker_settings(prompt.masks), "camera": camera.settings()}
    if prompt.extend and prompt.known:
        given["object"]["extends"] = str(Path(prompt.known).expanduser().absolute())
    else:
        given["object"]["model"] = prompt.known
    return settings.configure(**given)


def _configure_in_browser(
    prompt: PromptOptions,
    output: OutputOptions,
    performance: PerformanceOptions,
    tracking: TrackingOptions,
    camera: CameraOptions,
    settings: SettingsOptions,
) -> PipelineConfig:
    """See `settings_menu`."""
    return _configure(prompt, camera, tracking, settings, output, performance)


def _parse_prompts(prompt: PromptOptions, frames: str | None) -> PromptSet:
    """The objects that the options give."""
    from tracking3d.trackers.prompts.boxes import check_box_format
    from tracking3d.trackers.prompts.points import parse_points
    from tracking3d.trackers.prompts.prompt import PromptSet
    from tracking3d.video.source import parse_selection

    start = prompt.start_frame
    first = start if start is not None else parse_selection(frames).start
    box_format = check_box_format(prompt.box_format)
    boxes = [parse_given_box(text, first, box_format) for text in prompt.box or ()]
    masks = [one for file in prompt.mask or () for one in parse_given_masks(file)]
    points = [parse_points(text) for text in prompt.points or ()]
    several = len(boxes) + len(masks) + len(points) > 1
    return PromptSet(boxes, masks, points, start, as_lists=several, box_format=box_format)


def _parse_corrections(prompt: PromptOptions, objects: int) -> list[Correction]:
    from tracking3d.trackers.prompts.boxes import check_box_format
    from tracking3d.trackers.prompts.corrections import parse_correction, validate_corrections

    box_format = check_box_format(prompt.box_format)
    corrections = [parse_correction(text, box_format) for text in prompt.correct or ()]
    validate_corrections(corrections, max(objects, 1))  # before anything is written
    return corrections


def _command() -> str:
    """The command line, for the record; without the passwords in it."""
    from tracking3d.video.addresses import without_password

    return shlex.join(["tracking3d", *map(without_password, sys.argv[1:])])


def track_in_parts(request: RunRequest, display: RunDisplay, length: str, workers: int | None) -> None:
    """Track a video in parts, show the progress, and print a summary.

    Args:
        request: What is tracked.
        display: What is shown.
        length: Length of a part, as ``--split`` has it.
        workers: Processes at the same time; one per processor if None.

    Raises:
        InputError: Options do not go together.
    """
    from tracking3d.cli.progress import plan_run, show_progress
    from tracking3d.cli.report import report_at_end
    from tracking3d.pipeline.submaps.split_run import record_in_parts
    from tracking3d.video import open_source

    _check(request, workers, display)
    if display.quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    folder, options = request.folder, request.options
    with ExitStack() as ends:
        ends.enter_context(_resumable(folder))
        count = open_source(request.source, options.selection).count
        plan = plan_run(request.config.model_dump(), count, report=display.report)
        shown = ends.enter_context(show_progress(display.quiet, plan))
        reporting = ends.enter_context(report_at_end([folder] if display.report else []))
        listener = reporting(shown.show_frame)
        ended = record_in_parts(
            request.source,
            request.config,
            folder,
            request.prompts,
            length=length,
            workers=workers or _processors(),
            selection=options.selection,
            command=options.command,
            overwrite=options.overwrite,
            resume=options.resume,
            listener=listener,
        )
    if not display.quiet:
        _print_summaries(ended)


def _print_summaries(ended: SplitResult) -> None:
    """Print the closing table, or those of all parts and why they could not be merged."""
    from tracking3d.cli.summary import print_summary

    for one in ended.folders:
        print_summary(one)
    if len(ended.folders) > 1:
        folders = ", ".join(map(str, ended.folders))
        typer.echo(
            f"The {ended.parts} parts could not be merged: {ended.reason}. Each is a run of its own: {folders}.",
            err=True,
        )
    elif ended.reason:
        typer.echo(
            f"Tracked as one part: {ended.reason}. --split is for long videos, and photos need none.",
            err=True,
        )


def _check(request: RunRequest, workers: int | None, display: RunDisplay) -> None:
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: give at least 1.")
    if len(request.prompts) > 1:
        raise InputError("--split tracks one object; give one object, or leave out --split.")
    given = {
        "--start-frame": request.prompts.start_frame is not None,
        "--correct": bool(request.corrections),
        "--view": display.view,
        "--fps": request.fps is not None,
    }
    for option, value in given.items():
        if value:
            raise InputError(f"{option} cannot be combined with --split; leave out one of them.")


def _processors() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """If the run is stopped, say how to continue it."""
    from tracking3d.pipeline.submaps.plan import PARTS

    try:
        yield
    except BaseException as error:
        if (folder / PARTS).is_dir():
            error.add_note(
                f"Finished parts are kept in {folder}; to continue, repeat the command with --resume."
            )
        raise


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
    from tracking3d.trackers.prompts.boxes import parse_box

    if Path(text).is_file():
        from tracking3d.trackers.vot_regions import box_in_file

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
