"""``tracking3d view`` shows runs in the browser; ``run --view`` shows a run while it is tracked."""

from __future__ import annotations

import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, Video
from tracking3d.cli.options.output import Browser, Host, Port
from tracking3d.runtime.progress import report_progress

if TYPE_CHECKING:
    from tracking3d.frames import SkippedFrame
    from tracking3d.pipeline.record import Listener
    from tracking3d.results.records import FrameRecord
    from tracking3d.ui.viewer.viewer import Viewer
    from tracking3d.video.any_frame import FrameImages
    from tracking3d.video.source import FrameSource


def view(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Run folders, finished or still running.")
    ],
    source: Video = None,
    host: Host = None,
    port: Port = 8080,
    browser: Browser = True,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Show runs in the browser: model, camera path, video, masks, and uncertain frames. Ctrl-C stops the server.

    The page follows a run that is still running. Several runs are shown side by side.
    """
    from tracking3d.cli.progress import show_progress
    from tracking3d.ui.viewer.opening import check_viser, open_viewer

    check_viser("`tracking3d view`")
    from tracking3d.ui.web.access import Access

    with show_progress(quiet):
        report_progress("opening the viewer")
        viewer = open_viewer(runs, Access.on(host), port, source)
    try:
        show_address(viewer.address, browser and host is None)
        wait_for_the_end()
    finally:
        viewer.close()


@contextmanager
def watch(
    source: FrameSource, folder: Path, listener: Listener, host: str | None, quiet: bool
) -> Iterator[tuple[FrameSource, Listener]]:
    """Show a run while it is tracked, from its first estimate, and after its end until Ctrl-C.

    Args:
        source: The frames of the run.
        folder: Where it is written.
        listener: Called with every frame.
        host: See `Access.on`.
        quiet: Do not print the address.

    Yields:
        The source and the listener to give the run.

    Raises:
        PluginError: viser is not installed.
    """
    from tracking3d.errors import InputError
    from tracking3d.ui.viewer.opening import check_viser, open_viewer
    from tracking3d.ui.viewer.run_images import LatestImages
    from tracking3d.ui.web.access import Access
    from tracking3d.video.any_frame import frame_images

    check_viser("--view")
    opened: list[Viewer] = []
    kept = LatestImages(source)
    images: FrameImages = kept
    passed_on: FrameSource = kept
    with suppress(InputError):  # a camera gives each frame once
        images, passed_on = frame_images(source), source

    def listening(frame: FrameRecord | SkippedFrame) -> None:
        if not opened:
            opened.append(open_viewer([folder], Access.on(host), images=images))
            if not quiet:
                show_address(opened[0].address, host is None)
        listener(frame)

    try:
        yield passed_on, listening
        if opened:
            report_progress("showing the run until Ctrl-C")
            if not quiet:
                typer.echo("The viewer stays open; Ctrl-C stops it.", err=True)
            wait_for_the_end()
    finally:
        for viewer in opened:
            viewer.close()


def show_address(address: str, browser: bool) -> None:
    """Print the address of the page, and open it if the program was started from a terminal."""
    typer.echo(address, err=True)
    if browser and sys.stdin.isatty() and sys.stdout.isatty():
        webbrowser.open(address)


def wait_for_the_end() -> None:
    """Block until Ctrl-C."""
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        typer.echo("", err=True)
