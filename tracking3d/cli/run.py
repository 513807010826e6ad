"""``tracking3d run``: track an object through a video and write a run folder."""

from __future__ import annotations

import shlex
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from tracking3d.cli.model import check_fine
from tracking3d.cli.objects import check_object_options, given_box, given_masks
from tracking3d.cli.options import (
    ConfigFile,
    Debug,
    Overrides,
    Preset,
    Quality,
    Quiet,
    camera_settings,
    configure,
)
from tracking3d.cli.split import track_in_parts
from tracking3d.cli.tracking import Given, a_person_is_there, default_folder, track
from tracking3d.cli.view import Host
from tracking3d.errors import InputError

_TRACKING, _CAMERA, _RUNNING = "The object and how to track it", "The camera", "Running"


class ModelChoice(StrEnum):
    """What is made of the object at the end."""

    NONE = "none"
    FAST = "fast"
    FINE = "fine"


def run(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="Video file, folder or pattern of images, number of a camera, or http(s) or rtsp(s) address.",
        ),
    ],
    box: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,W,H|FILE",
            help="Object in the first frame, in pixels or as VOT's regions; may be repeated.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    mask: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE[@N|@all]",
            help="Mask of the object in the first frame, or object N of an indexed one; may be repeated.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    points: Annotated[
        list[str] | None,
        typer.Option(
            metavar="'X,Y+ X,Y-'",
            help="Points of the first frame on the object (+) and beside it (-); may be repeated.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    known: Annotated[
        str | None,
        typer.Option(
            "--object",
            metavar="RUN|MESH",
            help="The object is that of an earlier run, or this mesh; found without a box, or with one.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    start_frame: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="The object is given in frame N, and tracked both ways from there.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    correct: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FRAME:BOX|MASK|POINTS",
            help="The object in a later frame, from which the tracker goes on; may be repeated.",
            rich_help_panel=_TRACKING,
        ),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR|FILE[@N]",
            help="Masks of all frames: a folder, video, .npz, COCO's .json, VOT's .txt; the first is also the object.",
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
    distortion: Annotated[
        str | None,
        typer.Option(
            metavar="K1,K2,P1,P2,...",
            help="Of the lens, as OpenCV has it; fisheye:K1,K2,K3,K4 of a fisheye.",
            rich_help_panel=_CAMERA,
        ),
    ] = None,
    camera_file: Annotated[
        str | None,
        typer.Option(
            "--camera",
            metavar="FILE",
            help="Camera with its lens: OpenCV's or ROS's YAML, Kalibr, COLMAP's cameras.txt.",
            rich_help_panel=_CAMERA,
        ),
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
    fps: Annotated[
        float | None,
        typer.Option(help="Images per second of a folder or pattern of images.", rich_help_panel=_RUNNING),
    ] = None,
    skip_damaged: Annotated[
        bool,
        typer.Option(
            "--skip-damaged",
            help="Where the first frame cannot be read, take the box or mask for the first one that can.",
            rich_help_panel=_RUNNING,
        ),
    ] = False,
    split: Annotated[
        str | None,
        typer.Option(
            metavar="SECONDS",
            help="Track a long video in parts of such a length side by side, and join them.",
            rich_help_panel=_RUNNING,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="With --split: parts at a time; default all processors.",
            rich_help_panel=_RUNNING,
        ),
    ] = None,
    config: ConfigFile = None,
    preset: Preset = None,
    quality: Quality = None,
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
    report: Annotated[
        bool,
        typer.Option(
            "--report/--no-report",
            help="When the run has ended in whatever way, write report.html and turntable.mp4.",
            show_default=False,
            rich_help_panel=_RUNNING,
        ),
    ] = True,
    view: Annotated[
        bool,
        typer.Option(
            "--view", help="Look at the run in the browser while it goes on.", rich_help_panel=_RUNNING
        ),
    ] = False,
    host: Host = None,
    model: Annotated[
        ModelChoice | None,
        typer.Option(
            help="The mesh at the end: none takes no texture from the video, fast does, fine makes the shape anew too.",
            show_default="fast",
            rich_help_panel=_RUNNING,
        ),
    ] = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Track the object through SOURCE: masks, poses and a textured mesh in a run folder.

    Say what the object is by --box, --mask, --points, --masks or --object. Several boxes, masks or --points are several
    objects, each with a run folder of its own in the one of the run.
    """
    from tracking3d.config.loading import load_prompt

    told = load_prompt(config)
    boxes, object_masks, object_points = box or [], mask or [], points or []
    if not (boxes or object_masks or object_points or masks):
        boxes, object_points = list(told.box), list(told.points)
        object_masks = [Path(file) for file in told.mask]
    start_frame = told.start_frame if start_frame is None else start_frame
    if resume and overwrite:
        raise InputError(
            "Give either --resume or --overwrite: one keeps the run that is there, one does not."
        )
    if sum(map(bool, (boxes, object_masks, object_points))) > 1:
        raise InputError("Give either --box, --mask or --points, not more than one of them.")
    if host is not None and not view:
        raise InputError("--host is where --view serves its page; give both.")
    if workers is not None and split is None:
        raise InputError("--workers is how many parts of --split are tracked at a time; give both.")
    fine = model is ModelChoice.FINE
    if fine:
        check_fine(source)
    chosen: dict[str, Any] = {"name": tracker}
    if masks is not None:
        if tracker not in (None, "precomputed", "auto"):
            raise InputError(f"--masks is for the tracker precomputed; leave out --tracker {tracker}.")
        from tracking3d.trackers.mask_images import split_object

        path, number = split_object(masks)
        chosen = {"name": "precomputed", "path": str(path), "object": number}
    camera = camera_settings(fov, intrinsics, distortion, camera_file)
    settings = configure(
        config,
        preset,
        overrides,
        quality,
        tracker=chosen,
        features=features,
        camera=camera,
        object={
            "known": known,
            "flat": flat or None,
            "prototype": prototype,
            "texture_views": 0 if model is ModelChoice.NONE else None,
            "shape": None if model is None else "fine" if fine else "online",
        },
        window={"size": size},
        solver={"final_refine": final_refine},
        runtime={"device": device, "seed": seed, "on_plugin_failure": on_plugin_failure},
    )
    from tracking3d.arguments import needs_prompt
    from tracking3d.corrections import checked_corrections, parse_correction
    from tracking3d.point_prompts import parse_points
    from tracking3d.video.selection import parse_selection
    from tracking3d.video.stream import without_password

    first = start_frame if start_frame is not None else parse_selection(frames).start
    given = Given(
        [given_box(text, first) for text in boxes],
        [one for file in object_masks for one in given_masks(file)],
        [parse_points(text) for text in object_points],
    )
    corrections = [parse_correction(text) for text in correct or told.correct]
    checked_corrections(corrections, max(len(given), 1))  # before anything is written
    folder = out or default_folder(source)
    check_object_options(settings, len(given), fine, split is not None)
    if not given and needs_prompt(settings):
        if not a_person_is_there() or quiet or resume or source.isdigit():
            raise InputError(
                "Say what the object is in the first frame: --box X,Y,W,H, --mask FILE, --points 'X,Y+ X,Y-', or "
                "--masks DIR; or draw it with `tracking3d pick`."
            )
        from tracking3d.cli.pick import picked_in_browser

        typer.echo("Say in the browser what the object is; Ctrl-C ends it.", err=True)
        picked = picked_in_browser(source, frames, settings, folder, overwrite=overwrite)
        given, start_frame = Given(picked.boxes, picked.masks), picked.frame
    about = {
        "command": shlex.join(map(without_password, sys.argv)),
        "selection": frames,
        "overwrite": overwrite,
        "skip_damaged": skip_damaged,
        "resume": resume,
        "start_frame": start_frame,
        "corrections": corrections,
    }
    if split is not None:
        track_in_parts(
            source,
            settings,
            folder,
            given,
            about,
            split,
            workers=workers,
            fps=fps,
            quiet=quiet,
            report=report,
            view=view,
        )
    else:
        track(
            source,
            settings,
            folder,
            given,
            about,
            fps=fps,
            quiet=quiet,
            report=report,
            view=view,
            host=host,
        )
