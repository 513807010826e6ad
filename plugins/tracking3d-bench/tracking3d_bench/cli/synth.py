"""``tracking3d synth``: render synthetic sequences with exact ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracking3d.cli.options import Debug, Quiet, grouped, numbers
from tracking3d.cli.options.general import OUTPUT, PERFORMANCE
from tracking3d.errors import InputError
from tracking3d.runtime.progress import report_progress
from tracking3d_bench.cli.fresh import Count, Meshes, draw_suite

if TYPE_CHECKING:
    from tracking3d_bench.synthesis.spec import SequenceSpec

_ONE = "One sequence"


@dataclass(frozen=True)
class SequenceOptions:
    """One sequence: what it shows and how."""

    object_: Annotated[
        str | None,
        typer.Option(
            "--object",
            metavar="NAME|MESH",
            help="Object: box, bottle, blob, mug, card, wedge or vase; organic, assembly, stick, knob or bowl, whose "
            "shape depends on the seed; or a mesh file in metres.",
            rich_help_panel=_ONE,
        ),
    ] = None
    motion: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Motion: tumble, turntable, turn_and_back, flip, fast, depth_drift, leave_and_return, walk_round "
            "or pick_up.",
            rich_help_panel=_ONE,
        ),
    ] = None
    frames: Annotated[
        int | None, typer.Option(metavar="N", help="Number of frames.", rich_help_panel=_ONE)
    ] = None
    size: Annotated[
        str | None, typer.Option(metavar="W,H", help="Image size in pixels.", rich_help_panel=_ONE)
    ] = None
    degrees: Annotated[
        float | None,
        typer.Option(
            metavar="DEGREES",
            help="Rotation per frame; with the motion fast, its maximum.",
            rich_help_panel=_ONE,
        ),
    ] = None
    fov: Annotated[
        float | None,
        typer.Option(metavar="DEGREES", help="True vertical field of view.", rich_help_panel=_ONE),
    ] = None
    background: Annotated[
        str | None,
        typer.Option(
            metavar="DIR|procedural",
            help="Folder of background images, of which the seed chooses one; procedural paints one.",
            rich_help_panel=_ONE,
        ),
    ] = None
    textureless: Annotated[
        bool, typer.Option("--textureless", help="Paint the object in one colour.", rich_help_panel=_ONE)
    ] = False
    disturb: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=STRENGTH",
            help="Disturbance with a strength from 0 to 1: light, highlights, motion_blur, noise, low_contrast, "
            "occluder, wrong_fov or jpeg; may be repeated.",
            rich_help_panel=_ONE,
        ),
    ] = None
    seed: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Random seed; of the suites 'fresh' and 'phone' too.", rich_help_panel=_ONE
        ),
    ] = None

    def given(self) -> dict[str, Any]:
        """The options that are given, by the names of the command line."""
        values = {field.name.rstrip("_"): getattr(self, field.name) for field in fields(self)}
        values["textureless"] = self.textureless or None
        values["disturb"] = self.disturb or None
        return {name: value for name, value in values.items() if value is not None}


@grouped
def synth(
    sequence: SequenceOptions,
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="Folder for the suite, or for the single sequence.")
    ] = Path("synthetic"),
    suite: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Suite: smoke, standard, hard or full; or fresh or phone, which --seed draws.",
        ),
    ] = None,
    count: Count = None,
    meshes: Meshes = None,
    bop: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Write the sequences as a dataset in BOP format too.", rich_help_panel=OUTPUT
        ),
    ] = None,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Render again what is already complete.", rich_help_panel=OUTPUT),
    ] = False,
    jobs: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=1,
            max=256,
            help="Processes that render a suite.",
            rich_help_panel=PERFORMANCE,
        ),
    ] = 1,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Render sequences with exact masks, poses, depth and point tracks: a suite, or a single sequence.

    The images are ray traced, independently of the renderer that the tracker uses. Sequences that are already complete
    are kept.
    """
    given = sequence.given()
    drawn = draw_suite(suite or "one sequence", sequence.seed if suite else None, count, meshes)
    others = next((name for name in given if suite not in ("fresh", "phone") or name != "seed"), None)
    if suite is not None and others:
        raise InputError(f"--{others} cannot change --suite {suite}, which is fixed; leave out one of them.")
    if suite is not None:
        folders = _make_suite(*drawn, out, jobs, overwrite, quiet)
    elif sequence.object_ is not None:
        folders = _make_one(given, out, overwrite, quiet)
    else:
        raise InputError(
            "Give a suite with --suite smoke, standard, hard, full, fresh or phone, or one sequence with --object NAME."
        )
    if bop is not None:
        _export(folders, bop, quiet)


def _make_suite(
    name: str, drawn: list[SequenceSpec] | None, out: Path, jobs: int, overwrite: bool, quiet: bool
) -> list[Path]:
    from tracking3d.cli.progress import show_progress
    from tracking3d_bench.synthesis.suite import load_suite, make_suite

    specs = load_suite(name) if drawn is None else drawn
    with show_progress(quiet):
        listener = _count("rendering sequences", len(specs))
        folders = make_suite(name, out, specs=specs, jobs=jobs, overwrite=overwrite, listener=listener)
    if not quiet:
        typer.echo(f"{out}: {len(folders)} sequences")
    return folders


def _export(folders: list[Path], bop: Path, quiet: bool) -> None:
    from tracking3d_bench.datasets.bop_export import write_bop
    from tracking3d_bench.datasets.clip import read_truth

    write_bop(bop, [read_truth(folder) for folder in folders])
    if not quiet:
        typer.echo(f"{bop}: {len(folders)} scenes in BOP format")


def _make_one(settings: dict[str, Any], out: Path, overwrite: bool, quiet: bool) -> list[Path]:
    from tracking3d.cli.progress import show_progress
    from tracking3d_bench.synthesis.spec import check_spec
    from tracking3d_bench.synthesis.writing import is_complete, write_sequence

    names = {"degrees": "degrees_per_frame"}
    values = {names.get(name, name): value for name, value in settings.items()}
    values["textured"] = not values.pop("textureless", False)
    if "size" in values:
        values["size"] = [round(side) for side in numbers(values["size"], 2, "--size", "W,H")]
    values["disturbances"] = dict(_strength(item) for item in values.pop("disturb", []))
    spec = check_spec(values, "synth")
    if overwrite or not is_complete(out, spec):
        with show_progress(quiet):
            write_sequence(out, spec, _count("rendering frames", spec.frames))
    if not quiet:
        typer.echo(f"{out}: {spec.frames} frames")
    return [out]


def _strength(item: str) -> tuple[str, float]:
    """Read ``noise=0.5`` as a name and a number; the spec checks whether there is such a disturbance."""
    name, equals, value = item.partition("=")
    if not equals or not name:
        raise InputError(f"--disturb {item} is not NAME=STRENGTH; write it like noise=0.5.")
    return name.strip(), numbers(value, 1, f"--disturb {name}", "a number from 0 to 1")[0]


def _count(stage: str, total: int) -> Callable[[object], None]:
    """A function to call when a part of a stage is finished."""
    done = count(1)
    report_progress(stage, 0, total)
    return lambda part: report_progress(stage, next(done), total)


app = typer.Typer(add_completion=False)
app.command(name="synth")(synth)
