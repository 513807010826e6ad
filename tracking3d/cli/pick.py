"""``tracking3d pick``: mark the object in the browser; ``run`` without a prompt does so too, from a terminal."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quiet, configure
from tracking3d.cli.options.output import Browser, Host, Overwrite, RunFolder
from tracking3d.cli.options.panels import OUTPUT
from tracking3d.cli.options.tracking import Tracker
from tracking3d.cli.options.video import Frames
from tracking3d.cli.view import show_address

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.picker.session import Picked
    from tracking3d.prompts.prompt import PromptSet


def pick(
    source: Annotated[
        str, typer.Argument(metavar="VIDEO", help="Video file, image folder or quoted image pattern.")
    ],
    tracker: Tracker = None,
    out: RunFolder = None,
    overwrite: Overwrite = False,
    frames: Frames = None,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    host: Host = None,
    port: Annotated[
        int,
        typer.Option(
            min=0,
            max=65535,
            help="Port, or the next free one above it; 0 for any free port.",
            rich_help_panel=OUTPUT,
        ),
    ] = 8090,
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

    The page shows at once the mask that the tracker makes from it. It also offers the command and a YAML file to copy.
    """
    from tracking3d.cli.tracking import RunDisplay, RunRequest, default_folder, track
    from tracking3d.video.addresses import check_source_name

    check_source_name(source)
    settings = configure(config, preset, overrides, tracker={"name": tracker})
    if view:
        from tracking3d.viewer.opening import check_viser

        check_viser("--view")
    from tracking3d.pipeline.record import RecordOptions

    folder = out or default_folder(source)
    picked = picked_in_browser(source, frames, settings, folder, host, port, browser, overwrite)
    prompts = prompts_of(picked)
    options = RecordOptions(shlex.join(sys.argv), frames, overwrite)
    track(RunRequest(source, settings, folder, prompts, options), RunDisplay(quiet, view=view, host=host))


def prompts_of(picked: Picked) -> PromptSet:
    """The prompts that were marked in the browser."""
    from tracking3d.prompts.prompt import PromptSet

    several = len(picked.boxes) + len(picked.masks) > 1
    return PromptSet(picked.boxes, picked.masks, start_frame=picked.frame, as_lists=several)


def picked_in_browser(
    source: str,
    frames: str | None,
    settings: PipelineConfig,
    folder: Path,
    host: str | None = None,
    port: int = 8090,
    browser: bool = True,
    overwrite: bool = False,
) -> Picked:
    """Serve the page until the user starts the run.

    Args:
        source: The video.
        frames: ``START:STOP:STEP``.
        settings: Settings of the run.
        folder: The run folder.
        host: See `Access.on`.
        port: The port, or the next free one above it.
        browser: Open the page, if the program was started from a terminal.
        overwrite: Whether an earlier run in the folder may be replaced.

    Raises:
        InputError: The source cannot be paused, so that no frame can be picked.
        OutputError: There is a run in the folder.
    """
    from tracking3d.errors import InputError, OutputError
    from tracking3d.picker.outcome import command_of, save_outcome, settings_as_yaml
    from tracking3d.picker.server import Picker
    from tracking3d.picker.session import PickingSession
    from tracking3d.results import layout
    from tracking3d.video import open_source, parse_selection
    from tracking3d.video.any_frame import frame_images
    from tracking3d.video.selection import within
    from tracking3d.web.access import Access

    if (folder / layout.RUN).exists() and not overwrite:
        raise OutputError(f"{folder} already holds a run; give --overwrite or choose another {layout.OUT}.")
    opened, selection = open_source(source, frames), parse_selection(frames)
    if not opened.repeatable:
        raise InputError(f"{opened.name} cannot be paused to draw in; give the object with --box.")
    images = frame_images(opened)
    session = PickingSession(source, images, within(selection, images.count or opened.count or 1), settings)

    def save(picked: Picked) -> tuple[str, str]:
        save_outcome(picked, settings, folder, source)
        return command_of(picked, folder, source, frames), settings_as_yaml(settings)

    picker = Picker(session, save, Access.on(host), port)
    try:
        show_address(picker.address, browser and host is None)
        return picker.wait()
    finally:
        picker.close()
