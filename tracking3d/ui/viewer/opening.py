"""From run folders to a viewer that shows them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.errors import InputError, PluginError
from tracking3d.results.layout import check_run_folder, runs_in

if TYPE_CHECKING:
    from tracking3d.ui.viewer.followed_run import FollowedRun
    from tracking3d.ui.viewer.viewer import Viewer
    from tracking3d.ui.web.access import Access
    from tracking3d.video.any_frame import FrameImages

_log = logging.getLogger(__name__)
PORT = 8080
"""Where the viewer listens, or the next port that is free."""


def check_viser(what: str) -> None:
    """Make sure of the library that draws, before anything begins.

    Args:
        what: The command or option that needs it.

    Raises:
        PluginError: If it is not installed.
    """
    if find_spec("viser") is None:
        raise PluginError(f"{what} needs viser; install it with: pip install 'tracking3d[view]'.")


def open_viewer(
    folders: Sequence[Path],
    access: Access,
    port: int = PORT,
    source: str | None = None,
    images: FrameImages | None = None,
) -> Viewer:
    """Show runs in the browser.

    Args:
        folders: Run folders, or folders of the several objects of one video.
        access: Where to listen, and whom to serve.
        port: The port, or the next one that is free; 0 for any.
        source: The video, if it is not where the runs found it.
        images: Gives the frames of all runs, where they are at hand already.

    Raises:
        InputError: If a folder holds no run, or a damaged one.
        PluginError: If viser is not installed, or cannot be guarded.
    """
    check_viser("The viewer")
    for folder in folders:
        for run in runs_in(folder):
            check_run_folder(run)
    # Only now, because they need seconds to import.
    from tracking3d.ui.viewer.correcting import Corrections, RunCorrection
    from tracking3d.ui.viewer.followed_run import open_followed_runs
    from tracking3d.ui.viewer.run_images import images_of_run
    from tracking3d.ui.viewer.viewer import Video, Viewer
    from tracking3d.video.any_frame import frame_images
    from tracking3d.video.opening import open_source

    if images is None and source is not None:
        images = frame_images(open_source(source))
    videos, corrections = [], list[RunCorrection]()
    for folder in folders:
        runs = open_followed_runs(folder)
        if not runs:
            raise InputError(f"{folder} holds no run; give the --out folder of a `tracking3d run`.")
        own = images or images_of_run(str(runs[0].description.get("source", "")), runs[0].folder)
        if own is None:
            _log.warning("The video of the run %s was not found; give its path as --source.", folder)
        corrections += [RunCorrection(run, own, source, access) for run in runs]
        videos.append(Video(folder.name or str(folder), runs, own or _drawn_images_of(runs[0])))
    return Viewer(videos, access, port, Corrections(corrections, access))


def _drawn_images_of(run: FollowedRun) -> FrameImages | None:
    """The frames in the overlay video of a run."""
    from tracking3d.ui.viewer.run_images import OverlayPictures

    run.look_again()
    try:
        return OverlayPictures(run.folder, list(run.frames), run.camera.height, run.camera.width)
    except InputError:
        return None
