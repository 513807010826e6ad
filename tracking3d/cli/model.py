"""``tracking3d model``: rebuild the mesh of a run, its texture or its shape too."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, Run, Video
from tracking3d.cli.options.general import model_option
from tracking3d.cli.options.output import ObjectSize
from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.results.run_reader import RunReader


def _refuse_quality(value: str | None) -> None:
    """Answer the former option ``--quality fast|fine``."""
    from tracking3d.config.loading import check_quality

    if value is not None:
        check_quality(value)
        raise InputError(
            f"--quality {value} sets everything of a run, and this run exists already; choose its mesh by "
            "--model auto, none, fast or fine."
        )


def model(
    run: Run,
    model: Annotated[str, model_option()] = "auto",
    quality: Annotated[str | None, typer.Option(hidden=True, callback=_refuse_quality)] = None,
    extend: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN", help="An earlier run of the same object, whose frames make the model too."
        ),
    ] = None,
    object_size: ObjectSize = None,
    source: Video = None,
    views: Annotated[
        int | None,
        typer.Option(
            min=1, max=500, show_default="as in the run", help="Frames that the texture is taken from."
        ),
    ] = None,
    largest: Annotated[
        int | None,
        typer.Option(
            min=64, max=8192, show_default="as in the run", help="Maximum side of the texture, in texels."
        ),
    ] = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Make the final mesh of a run again, from its video: by default the one that `tracking3d run` makes.

    --model means the same as there. With --extend the frames of an earlier run of
    the same object make shape and texture, too. The run's contact sheet, report and turntable
    are made again, if it has them.
    """
    from tracking3d.results.layout import check_run_folder

    check_run_folder(run)
    from tracking3d.cli.progress import load_with_progress, show_progress

    load_with_progress("tracking3d.reconstruction.rebuild", quiet, kernels=True)
    from tracking3d.results.checkpoint.staging import take_over

    take_over(run)
    from tracking3d.reconstruction.final_shape import texture_limits
    from tracking3d.results.run_reader import RunReader
    from tracking3d.ui.report.several import renew_report

    config = _settings_of_run(RunReader(run))
    if extend is None and model == "auto" and config.object.extends is not None:
        extend = Path(config.object.extends)
    most, texels = texture_limits(config)
    limits = most if views is None else views, texels if largest is None else largest
    if extend is None:
        if model == "auto":
            model = _default_model(RunReader(run), config, keeps=views is None and largest is None)
        outcome = _make_mesh(run, model, source, *limits, quiet)
    else:
        check_run_folder(extend)
        outcome = _extend_mesh(run, extend, source, *limits, quiet)
    if object_size is not None:
        from tracking3d.results.run_unit import scale_run

        scale_run(run, object_size)
        outcome.append(f"{run}: all lengths are in metres")
    with show_progress(quiet):
        outcome += map(str, renew_report(run))
    if not quiet:
        typer.echo("\n".join(outcome))


def _settings_of_run(run: RunReader) -> PipelineConfig:
    """The settings of a run, but with the final mesh that is made by default; those of an old version do not count."""
    from pydantic import ValidationError

    from tracking3d.config.loading import set_model
    from tracking3d.config.models import PipelineConfig

    try:
        return set_model(PipelineConfig.model_validate(run.config), "auto")
    except ValidationError:
        return PipelineConfig()


def _default_model(run: RunReader, config: PipelineConfig, keeps: bool) -> str:
    """What --model auto comes to; a new shape that did not explain the frames better is not tried again.

    Args:
        run: The run.
        config: See `_settings_of_run`.
        keeps: Whether a texture that the run has from its video already is what was asked for.
    """
    from tracking3d.reconstruction.final_shape import is_reconstructed
    from tracking3d.results.layout import ONLINE

    if config.object.model is not None:
        return "none"
    refused = "shape" in run.description and not (run.mesh_folder / ONLINE).is_dir()
    if is_reconstructed(run.frames, config) and not (keeps and refused):
        return "fine"
    refined = (run.description.get("refinement") or {}).get("frames")
    textured = run.config.get("object", {}).get("texture_views")
    return "none" if keeps and refined and textured else "fast"


def _make_mesh(run: Path, model: str, source: str | None, views: int, largest: int, quiet: bool) -> list[str]:
    """Make the mesh of a run, and return what to print about it."""
    from tracking3d.cli.progress import plan_shape, plan_texture, show_progress
    from tracking3d.reconstruction.rebuild import rebuild_shape, restore_online_mesh, retexture_run
    from tracking3d.rendering.backend import share_threads
    from tracking3d.results.run_notes import note_in_run
    from tracking3d.results.run_reader import RunReader

    if model == "none":
        restored = restore_online_mesh(run)
        return [
            f"{run}: {'the online mesh again' if restored else 'has the online mesh already; it stays as it is'}"
        ]
    frames, outcome = len(RunReader(run).frames), []
    if model == "fine":
        with show_progress(quiet, plan_shape(frames)), share_threads(1):
            shaped = rebuild_shape(run, source, views, largest)
        note_in_run(run, {"shape": shaped.sentence})
        made, taken = shaped.model, shaped.views
        outcome.append(
            f"{run}: {len(made.faces)} faces; {shaped.sentence}" if shaped.new else shaped.sentence
        )
    else:
        with show_progress(quiet, plan_texture(frames)), share_threads(1):
            made, taken = retexture_run(run, source, views, largest)
    size = len(made.texture)
    return [*outcome, f"{run}: texture of {size} x {size} texels from {taken} frames"]


def _extend_mesh(
    run: Path, earlier: Path, source: str | None, views: int, largest: int, quiet: bool
) -> list[str]:
    """Make the mesh of a run with the frames of an earlier one, and return what to print about it."""
    from tracking3d.cli.progress import plan_shape, show_progress
    from tracking3d.reconstruction.extension import extend_run
    from tracking3d.rendering.backend import share_threads
    from tracking3d.results.run_notes import note_in_run
    from tracking3d.results.run_reader import RunReader

    frames = len(RunReader(run).frames) + len(RunReader(earlier).frames)
    with show_progress(quiet, plan_shape(frames)), share_threads(1):
        extended = extend_run(run, earlier, source, views, largest)
    note_in_run(run, {"shape": extended.sentence})
    made = extended.shaped.model
    return [
        f"{run}: {len(made.faces)} faces; {extended.sentence}",
        f"{run}: texture of {len(made.texture)} x {len(made.texture)} texels from {extended.shaped.views} frames",
    ]


def check_model_source(model: str | None, source: str) -> None:
    """Make sure, before anything is tracked, that the final mesh can be made at the end.

    Raises:
        InputError: The source is a camera, whose frames cannot be read twice, or a package is missing.
    """
    if model in ("fast", "fine") and source.isdigit() and not Path(source).exists():
        raise InputError(
            f"--model {model} reads the video a second time, which a camera does not allow; leave it out."
        )
    if model == "fine":
        from tracking3d.reconstruction.rebuild import check_packages

        check_packages()
