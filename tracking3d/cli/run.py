"""``tracking3d run``: track an object through a video and write a run folder."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quiet, configure, numbers
from tracking3d.cli.view import Host, watched
from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig

_TRACKING, _CAMERA, _RUNNING = "The object and how to track it", "The camera", "Running"


def run(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="Video file, folder or pattern of images, or the number of a camera."
        ),
    ],
    box: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,W,H",
            help="Object in the first frame, in pixels; may be repeated.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    mask: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Mask of the object in the first frame; may be repeated.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Masks of all frames, as a folder, video or .npz; the first is also the object.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    tracker: Annotated[
        str | None, typer.Option(metavar="NAME", help="Mask tracker.", rich_help_panel=_TRACKING)
    ] = None,
    features: Annotated[
        str | None, typer.Option(metavar="NAME", help="Feature encoder.", rich_help_panel=_TRACKING)
    ] = None,
    flat: Annotated[
        bool, typer.Option("--flat", help="The object is flat, like a card.", rich_help_panel=_TRACKING)
    ] = False,
    prototype: Annotated[
        str | None,
        typer.Option(help="First shape: sphere, ellipsoid or a mesh file.", rich_help_panel=_TRACKING),
    ] = None,
    fov: Annotated[
        float | None, typer.Option(help="Vertical field of view in degrees.", rich_help_panel=_CAMERA)
    ] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(metavar="FX,FY,CX,CY", help="In pixels of the full frame.", rich_help_panel=_CAMERA),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Run folder; default runs/<source>.", rich_help_panel=_RUNNING),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a run in that folder.", rich_help_panel=_RUNNING)
    ] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the stopped run in that folder.", rich_help_panel=_RUNNING),
    ] = False,
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="START:STOP:STEP", help="Which frames, counted from 0.", rich_help_panel=_RUNNING
        ),
    ] = None,
    skip_damaged: Annotated[
        bool,
        typer.Option(
            "--skip-damaged",
            help="Where the first frame cannot be read, take the box or mask for the first one that can.",
            rich_help_panel=_RUNNING,
        ),
    ] = False,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    size: Annotated[
        int | None, typer.Option(help="Working resolution in pixels.", rich_help_panel=_RUNNING)
    ] = None,
    device: Annotated[str | None, typer.Option(help="cpu, cuda or cuda:N.", rich_help_panel=_RUNNING)] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of everything random.", rich_help_panel=_RUNNING)
    ] = None,
    final_refine: Annotated[
        bool | None,
        typer.Option(
            "--final-refine/--no-final-refine",
            help="When a file ends, answer for all frames once more; both answers are kept.",
            show_default=False,
            rich_help_panel=_RUNNING,
        ),
    ] = None,
    on_plugin_failure: Annotated[
        str | None,
        typer.Option(
            metavar="continue|stop",
            help="When a plug-in fails in a later frame: go on with the last mask, or stop.",
            rich_help_panel=_RUNNING,
        ),
    ] = None,
    view: Annotated[
        bool,
        typer.Option(
            "--view", help="Look at the run in the browser while it goes on.", rich_help_panel=_RUNNING
        ),
    ] = False,
    host: Host = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Track the object through SOURCE: masks, poses and a textured mesh in a run folder.

    Say what the object is by --box, --mask or --masks. Several boxes or masks are several objects, each with a run
    folder of its own in the one of the run.
    """
    boxes, object_masks = box or [], mask or []
    if resume and overwrite:
        raise InputError(
            "Give either --resume or --overwrite: one keeps the run that is there, one does not."
        )
    if boxes and object_masks:
        raise InputError("Give either --box or --mask, not both.")
    if host is not None and not view:
        raise InputError("--host is where --view serves its page; give both.")
    chosen: dict[str, str | None] = {"name": tracker}
    if masks is not None:
        if tracker not in (None, "precomputed"):
            raise InputError(f"--masks is for the tracker precomputed; leave out --tracker {tracker}.")
        chosen = {"name": "precomputed", "path": str(masks)}
    camera = None
    if intrinsics is not None:
        camera = numbers(intrinsics, 4, "--intrinsics", "FX,FY,CX,CY in pixels")
    settings = configure(
        config,
        preset,
        overrides,
        tracker=chosen,
        features=features,
        camera={"fov": fov, "intrinsics": camera},
        object={"flat": flat or None, "prototype": prototype},
        window={"size": size},
        solver={"final_refine": final_refine},
        runtime={"device": device, "seed": seed, "on_plugin_failure": on_plugin_failure},
    )
    folder = out or default_folder(source)
    about: dict[str, Any] = {
        "command": shlex.join(sys.argv),
        "overwrite": overwrite,
        "skip_damaged": skip_damaged,
        "resume": resume,
    }
    given: Sequence[Any] = object_masks
    places: Sequence[Any] = []
    if boxes or object_masks or settings.tracker.name == "precomputed":
        from tracking3d.prompts import parse_box

        places = [parse_box(text) for text in boxes]
    elif a_person_is_there() and not (quiet or resume or source.isdigit()):
        from tracking3d.cli.pick import picked_in_browser, start_of

        typer.echo("Say in the browser what the object is; Ctrl-C ends it.", err=True)
        picked = picked_in_browser(source, frames, settings, folder, overwrite=overwrite)
        places, given, frames = picked.boxes, picked.masks, start_of(picked, frames)
    else:
        raise InputError(
            "Say what the object is in the first frame: --box X,Y,W,H, --mask FILE, or --masks DIR; "
            "or draw it with `tracking3d pick`."
        )
    track(source, frames, settings, folder, places, given, about, quiet, view, host)


def track(
    source: str,
    frames: str | None,
    settings: PipelineConfig,
    folder: Path,
    boxes: Sequence[Any],
    masks: Sequence[Any],
    about: dict[str, Any],
    quiet: bool,
    view: bool = False,
    host: str | None = None,
) -> None:
    """Track what boxes or masks say, show how it goes, and print what came of it.

    Args:
        source: What SOURCE is.
        frames: ``START:STOP:STEP``.
        settings: The configuration.
        folder: The run folder.
        boxes: One for each object, or none.
        masks: One for each object, as an array or a file, or none.
        about: Further arguments of `tracking3d.recording.record`.
        quiet: Print nothing.
        view: Show the run in the browser.
        host: Where that is served.
    """
    from tracking3d.cli.progress import print_summary, progress
    from tracking3d.recording import record, record_objects
    from tracking3d.results.layout import object_folders
    from tracking3d.results.run_reader import is_finished
    from tracking3d.video import open_source

    opened = open_source(source, frames)
    about = {**about, "selection": frames}
    if quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    objects = max(len(boxes) + len(masks), 1)
    folders = object_folders(folder, objects) if objects > 1 else [folder]
    done = {one for one in folders if about.get("resume") and is_finished(one)}
    with ExitStack() as ends:
        ends.enter_context(resumable(folders))
        about["listener"] = ends.enter_context(progress(opened.count, quiet, objects))
        if view:
            opened, about["listener"] = ends.enter_context(
                watched(opened, folder, about["listener"], host, quiet)
            )
        if objects > 1:
            record_objects(opened, settings, folder, boxes=boxes, masks=masks, **about)
        else:
            the_box, the_mask = next(iter(boxes), None), next(iter(masks), None)
            record(opened, settings, folder, box=the_box, mask=the_mask, **about)
    for one in () if quiet else folders:
        if one in done:
            typer.echo(f"The run {one} is finished already; there is nothing to resume.")
        else:
            print_summary(one)


def a_person_is_there() -> bool:
    """Whether the program was called from a terminal, not by a script."""
    return sys.stdin is not None and sys.stdin.isatty() and sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def resumable(folders: list[Path]) -> Iterator[None]:
    """Whatever stops a run, it says how to go on, where that is possible."""
    from tracking3d.results.layout import has_state

    try:
        yield
    except BaseException as error:
        if any(has_state(folder) for folder in folders):
            error.add_note("The same command with --resume goes on from there.")
        raise


def default_folder(source: str) -> Path:
    """``runs/<name>`` after the file, the folder of images, or the camera."""
    if source.isdigit() and not Path(source).exists():
        return Path("runs", f"camera_{source}")
    path = Path(source).expanduser().absolute()
    if any(sign in path.name for sign in "*?["):
        path = path.parent
    if path.name in ("frames", "images"):
        path = path.parent
    return Path("runs", path.stem if path.is_file() else path.name)
