"""``tracking3d pick``: mark the object in the browser; ``run`` without a prompt does so too, from a terminal."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.model import check_model_source
from tracking3d.cli.options import Debug, Quiet, SettingsOptions, grouped
from tracking3d.cli.options.general import OUTPUT
from tracking3d.cli.options.output import Browser, Host, Overwrite, Port, RunFolder
from tracking3d.cli.options.tracking import CameraOptions, Features, Frames, Tracker, TrackingOptions
from tracking3d.cli.view import show_address

if TYPE_CHECKING:
    from tracking3d.cli.tracking import RunDisplay, RunRequest
    from tracking3d.config.models import PipelineConfig
    from tracking3d.trackers.prompts.prompt import PromptSet
    from tracking3d.ui.picker.server import Picker
    from tracking3d.ui.picker.session import ChosenSettings, Picked, SettingsMenu


@grouped
def pick(
    source: Annotated[
        str, typer.Argument(metavar="VIDEO", help="Video file, image folder or quoted image pattern.")
    ],
    tracker: Tracker = None,
    features: Features = None,
    out: RunFolder = None,
    overwrite: Overwrite = False,
    frames: Frames = None,
    *,
    settings: SettingsOptions,
    camera: CameraOptions,
    host: Host = None,
    port: Port = 8090,
    browser: Browser = True,
    view: Annotated[
        bool,
        typer.Option(
            "--view", help="Show the run in the viewer once it has started.", rich_help_panel=OUTPUT
        ),
    ] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Mark the object in the browser with a box, points or a brush on any frame, then start the run from the page.

    The page shows at once the mask that the tracker makes from it. Tracker, quality, final mesh, features and lens can
    be changed there. It also offers the command and a YAML file to copy.
    """
    from tracking3d.cli.progress import load_with_progress, show_progress
    from tracking3d.cli.tracking import RunDisplay, RunRequest, default_folder, track
    from tracking3d.video.addresses import check_source_name

    check_source_name(source)
    tracking = TrackingOptions(tracker, features)
    menu = settings_menu(source, frames, tracking, camera, settings, _configure)
    with show_progress(quiet):  # plug-ins are imported to check their options
        config = menu.configure(menu.chosen)
    load_with_progress("tracking3d.pipeline.record", quiet)
    if view:
        from tracking3d.ui.viewer.opening import check_viser

        check_viser("--view")
    from tracking3d.pipeline.record import RecordOptions
    from tracking3d.trackers.prompts.prompt import PromptSet

    options = RecordOptions(None, frames, overwrite)
    request = RunRequest(source, config, out or default_folder(source), PromptSet(), options)
    with closing(open_picker(request, menu, host, port, browser)) as page:
        track_picked(page, request, RunDisplay(quiet, view=view, host=host), track)


def track_picked(
    page: Picker, request: RunRequest, display: RunDisplay, start: Callable[[RunRequest, RunDisplay], None]
) -> None:
    """Wait for what is picked, or continue with what was picked before; the page shows the run until it is left.

    Args:
        page: The page.
        request: The run, without its objects.
        display: What the terminal shows.
        start: What tracks.
    """
    from tracking3d.cli.progress import load_with_progress
    from tracking3d.ui.picker.correction import command_of

    resume = page.picked is not None
    picked, options = page.wait(), request.options
    load_with_progress("tracking3d.pipeline.record", display.quiet, kernels=True)
    command = command_of(picked, request.folder, request.source, options.selection)
    options = replace(options, command=command, resume=resume)
    config = picked.config or request.config
    start(
        replace(request, config=config, prompts=prompts_of(picked), options=options),
        replace(display, page=page),
    )
    if not display.quiet:
        typer.echo("The page goes on until it is closed in the browser; Ctrl-C ends it, too.", err=True)
    with suppress(KeyboardInterrupt):
        page.wait_until_left()


def _configure(tracking: TrackingOptions, camera: CameraOptions, settings: SettingsOptions) -> PipelineConfig:
    """The configuration that the options make together."""
    return settings.configure(
        tracker={"name": tracking.tracker}, features=tracking.features, camera=camera.settings()
    )


Configure = Callable[[TrackingOptions, CameraOptions, SettingsOptions], "PipelineConfig"]
"""Makes the configuration of a run from the options that the page can change."""


def settings_menu(
    source: str,
    frames: str | None,
    tracking: TrackingOptions,
    camera: CameraOptions,
    settings: SettingsOptions,
    configure: Configure,
) -> SettingsMenu:
    """The settings that the page offers, those of the command line at first.

    Args:
        source: The video.
        frames: ``START:STOP:STEP``.
        tracking: Options of the command line, of which the page changes tracker and features.
        camera: The same; field of view and intrinsics.
        settings: The same; quality and final mesh.
        configure: Makes the configuration from such options.
    """
    from tracking3d.ui.picker.session import ChosenSettings, SettingsMenu

    lens = camera.settings()
    at_first = ChosenSettings(
        tracker=tracking.tracker,
        quality=settings.quality,
        model=settings.model,
        features=tracking.features,
        fov=lens["fov"],
        intrinsics=lens.get("intrinsics"),
    )

    def configure_run(chosen: ChosenSettings) -> PipelineConfig:
        check_model_source(chosen.model, source)
        as_given = (chosen.fov, chosen.intrinsics) == (at_first.fov, at_first.intrinsics)
        text = chosen.intrinsics and ",".join(map(repr, chosen.intrinsics))
        config = configure(
            replace(tracking, tracker=chosen.tracker, features=chosen.features),
            camera if as_given else replace(camera, fov=chosen.fov, intrinsics=text),
            replace(settings, quality=chosen.quality, model=chosen.model),
        )
        return _with_named_tracker(config, source, frames)

    return SettingsMenu(at_first, configure_run)


def _with_named_tracker(config: PipelineConfig, source: str, frames: str | None) -> PipelineConfig:
    """The configuration with a tracker in place of ``auto``, since the page shows its masks."""
    from tracking3d.config.models import AUTO
    from tracking3d.frames import Frame
    from tracking3d.pipeline.tracker_selection import choose_tracker
    from tracking3d.video import open_source

    if config.tracker.name != AUTO or not (opened := open_source(source, frames)).repeatable:
        return config
    first = next((frame for frame in opened if isinstance(frame, Frame)), None)
    return config if first is None else choose_tracker(config, opened.count, False, first.size)[0]


def prompts_of(picked: Picked) -> PromptSet:
    """The prompts that were marked in the browser."""
    from tracking3d.trackers.prompts.prompt import PromptSet

    several = len(picked.boxes) + len(picked.masks) > 1
    return PromptSet(picked.boxes, picked.masks, start_frame=picked.frame, as_lists=several)


def open_picker(
    request: RunRequest,
    menu: SettingsMenu | None,
    host: str | None = None,
    port: int = 8090,
    browser: bool = True,
) -> Picker:
    """Serve the page; if the run in the folder was stopped, that is continued, and nothing is picked.

    Args:
        request: The run, without its objects.
        menu: The settings that the page offers; None if they are fixed.
        host: See `Access.on`.
        port: The port, or the next free one above it.
        browser: Open the page, if the program was started from a terminal.

    Raises:
        InputError: The source cannot be paused, so that no frame can be picked.
        OutputError: There is a run in the folder.
    """
    from tracking3d.errors import InputError, OutputError
    from tracking3d.results import layout
    from tracking3d.results.overwrite import check_output_folder
    from tracking3d.ui.picker.correction import command_of, read_outcome, save_outcome, settings_as_yaml
    from tracking3d.ui.picker.server import Picker
    from tracking3d.ui.picker.session import PickingSession
    from tracking3d.ui.web.access import Access
    from tracking3d.video import open_source, parse_selection
    from tracking3d.video.any_frame import frame_images
    from tracking3d.video.source import within

    source, folder, options = request.source, request.folder, request.options
    frames, overwrite = options.selection, options.overwrite
    picked = None if overwrite else read_outcome(folder)
    if (folder / layout.RUN).exists() and not overwrite and picked is None:
        raise OutputError(f"{folder} already holds a run; give --overwrite or choose another {layout.OUT}.")
    check_output_folder(folder, overwrite)
    opened, selection = open_source(source, frames), parse_selection(frames)
    if not opened.repeatable:
        raise InputError(f"{opened.name} cannot be paused to draw in; give the object with --box.")
    images = frame_images(opened)
    indices = within(selection, images.count or opened.count or 1)
    session = PickingSession(source, images, indices, request.config, menu)

    def save(picked: Picked) -> tuple[str, str]:
        chosen = picked.config or request.config
        save_outcome(picked, chosen, folder, source)
        return command_of(picked, folder, source, frames), settings_as_yaml(chosen)

    picker = Picker(session, save, Access.on(host), port, picked)
    show_address(picker.address, browser and host is None)
    return picker
