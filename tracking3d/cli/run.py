"""``tracking3d run``: track an object through a video and write a run folder."""

from __future__ import annotations

import shlex
import sys
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from tracking3d.cli.model import check_model_source
from tracking3d.cli.objects import (
    check_extended,
    check_files,
    check_known,
    parse_given_box,
    parse_given_masks,
)
from tracking3d.cli.options import Debug, Quiet, SettingsOptions, grouped
from tracking3d.cli.options.camera import CameraOptions
from tracking3d.cli.options.output import OutputOptions
from tracking3d.cli.options.performance import PerformanceOptions
from tracking3d.cli.options.prompt import PromptOptions
from tracking3d.cli.options.tracking import TrackingOptions
from tracking3d.cli.options.video import Source, VideoOptions
from tracking3d.cli.pick import open_picker, settings_menu, track_picked
from tracking3d.cli.split import track_in_parts
from tracking3d.cli.tracking import RunDisplay, RunRequest, a_person_is_there, default_folder, track
from tracking3d.errors import InputError
from tracking3d.runtime.garbage_collection import collection_deferred

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.prompts.corrections import Correction
    from tracking3d.prompts.prompt import PromptSet


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
    from tracking3d.video.given_rates import validate_fps

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


def _configure(
    prompt: PromptOptions,
    camera: CameraOptions,
    tracking: TrackingOptions,
    settings: SettingsOptions,
    output: OutputOptions,
    performance: PerformanceOptions,
) -> PipelineConfig:
    """The configuration that the options make together."""
    return settings.configure(
        tracker=tracking.tracker_settings(prompt.masks),
        features=tracking.features,
        camera=camera.settings(),
        object={
            "model": None if prompt.extend else prompt.known,
            "extends": str(Path(prompt.known).expanduser().absolute())
            if prompt.extend and prompt.known
            else None,
            "flat": tracking.flat or None,
            "trust_masks": tracking.trust_masks or None,
            "prototype": tracking.prototype,
            "size": output.object_size,
        },
        crop={"size": performance.size},
        solver={"final_refine": tracking.final_refine},
        runtime={
            "device": performance.device,
            "seed": tracking.seed,
            "on_plugin_failure": tracking.on_plugin_failure,
        },
    )


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
    from tracking3d.prompts.boxes import check_box_format
    from tracking3d.prompts.points import parse_points
    from tracking3d.prompts.prompt import PromptSet
    from tracking3d.video.selection import parse_selection

    start = prompt.start_frame
    first = start if start is not None else parse_selection(frames).start
    box_format = check_box_format(prompt.box_format)
    boxes = [parse_given_box(text, first, box_format) for text in prompt.box or ()]
    masks = [one for file in prompt.mask or () for one in parse_given_masks(file)]
    points = [parse_points(text) for text in prompt.points or ()]
    several = len(boxes) + len(masks) + len(points) > 1
    return PromptSet(boxes, masks, points, start, as_lists=several, box_format=box_format)


def _parse_corrections(prompt: PromptOptions, objects: int) -> list[Correction]:
    from tracking3d.prompts.boxes import check_box_format
    from tracking3d.prompts.corrections import parse_correction, validate_corrections

    box_format = check_box_format(prompt.box_format)
    corrections = [parse_correction(text, box_format) for text in prompt.correct or ()]
    validate_corrections(corrections, max(objects, 1))  # before anything is written
    return corrections


def _command() -> str:
    """The command line, for the record; without the passwords in it."""
    from tracking3d.video.addresses import without_password

    return shlex.join(["tracking3d", *map(without_password, sys.argv[1:])])
