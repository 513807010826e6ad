"""``tracking3d pick``: say in the browser what the object is; and ``run`` without a box, where a person is there."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quiet, configure
from tracking3d.cli.view import Browser, Host, show_address

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.picker.session import Picked


def pick(
    source: Annotated[str, typer.Argument(metavar="VIDEO", help="Video file, folder or pattern of images.")],
    tracker: Annotated[str | None, typer.Option(metavar="NAME", help="Mask tracker.")] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Run folder; default runs/<source>.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run in that folder.")] = False,
    frames: Annotated[
        str | None, typer.Option(metavar="START:STOP:STEP", help="Which frames, counted from 0.")
    ] = None,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    host: Host = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Or the next one that is free; 0 for any.")
    ] = 8090,
    browser: Browser = True,
    view: Annotated[
        bool, typer.Option("--view", help="Look at the run, once it is started, in the viewer.")
    ] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Say in the browser what the object is: box, points or paint on any frame. Then start the run there.

    The mask that the tracker makes of it is shown at once. The command and a YAML file can be copied instead.
    """
    from tracking3d.cli.tracking import Given, default_folder, track
    from tracking3d.viewer.opening import check_viser

    if view:
        check_viser("--view")
    settings = configure(config, preset, overrides, tracker={"name": tracker})
    folder = out or default_folder(source)
    picked = picked_in_browser(source, frames, settings, folder, host, port, browser, overwrite)
    about = {
        "command": shlex.join(sys.argv),
        "selection": frames,
        "overwrite": overwrite,
        "start_frame": picked.frame,
    }
    given = Given(picked.boxes, picked.masks)
    track(source, settings, folder, given, about, quiet=quiet, view=view, host=host)


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
    """Serve the page until the person starts the run.

    Args:
        source: The video.
        frames: ``START:STOP:STEP``.
        settings: Of the run.
        folder: The run folder.
        host: See `Access.on`.
        port: The port, or the next one that is free.
        browser: Open the page, where a person sits at this machine.
        overwrite: Whether a run that is in the folder may be replaced.

    Raises:
        InputError: If the video is none that frames can be picked in.
        OutputError: If there is a run in the folder.
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
        raise OutputError(f"{folder} holds a run already; give --overwrite or choose another {layout.OUT}.")
    opened, selection = open_source(source, frames), parse_selection(frames)
    if not opened.repeatable:
        raise InputError(f"{opened.name} does not wait while one draws; say by --box what the object is.")
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
