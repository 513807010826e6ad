"""``tracking3d bench track``: how fast a clip is tracked, end to end."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quality


def track(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="Clip with frames/ and init.json or masks/.")],
    frames: Annotated[int | None, typer.Option(min=2, metavar="N", help="The first N frames only.")] = None,
    tracker: Annotated[str | None, typer.Option(metavar="NAME", help="Mask tracker.")] = None,
    paper_frames: Annotated[
        int, typer.Option(min=0, metavar="N", help="Frames with the preset paper beside it; 0 leaves it out.")
    ] = 3,
    against: Annotated[
        str | None, typer.Option(metavar="TAG", help="A version of the git checkout beside it.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="How often, in turn; the median run counts.")] = 1,
    final_refine: Annotated[
        bool,
        typer.Option("--final-refine/--no-final-refine", help="Look at all frames once more at the end."),
    ] = True,
    config: ConfigFile = None,
    preset: Preset = None,
    quality: Quality = None,
    overrides: Overrides = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Stages of every frame as .svg, .png or .pdf.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Track a clip from its box: frames a second end to end, stages with their shares, percentiles, memory."""
    import json
    import tempfile

    from tracking3d.cli.options import configure
    from tracking3d.cli.tables import print_table
    from tracking3d_bench.benchmark.track_speed import Contender, as_figures, check_out, measure
    from tracking3d_bench.benchmark.track_speed_table import plot_stages, speed_table, stage_table
    from tracking3d_bench.datasets.clip import read_truth
    from tracking3d_bench.speed.plot import check_plot

    if plot is not None:
        check_plot(plot)
    configure(config, preset, overrides, quality, tracker={"name": tracker})  # what is wrong is said at once
    truth = read_truth(clip)
    chosen = ("--tracker", tracker) if tracker else ()
    given = [
        *(("--config", str(config)) if config else ()),
        *(("--preset", preset) if preset else ()),
        *(("--quality", quality) if quality else ()),
        *(word for one in overrides or () for word in ("--set", one)),
        *chosen,
        "--final-refine" if final_refine else "--no-final-refine",
    ]
    with tempfile.TemporaryDirectory(prefix="tracking3d-speed-") as folder:
        contenders = [Contender("this version", tuple(given), frames)]
        if paper_frames:
            contenders.append(Contender("preset paper", ("--preset", "paper", *chosen), paper_frames))
        if against is not None:
            earlier = check_out(against, Path(folder) / "earlier")
            contenders.append(Contender(against, tuple(given), frames, earlier))
        speeds = measure(
            truth, contenders, Path(folder), repeats, lambda words: typer.echo(f"{words} ...", err=True)
        )
    if plot is not None:
        plot_stages(speeds, plot)
    if as_json:
        typer.echo(json.dumps(as_figures(speeds)))
        return
    print_table(speed_table(speeds))
    typer.echo()
    print_table(stage_table(speeds))
