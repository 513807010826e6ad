"""``tracking3d bench matching``: feature encoders by themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug


def matching(
    features: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[LABEL=]NAME[:OPTION=VALUE,...]",
            help="Feature encoder; may be repeated. The first one is what times are compared with.",
            show_default="every encoder that needs no options",
        ),
    ] = None,
    images: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="PATH",
            help="Photograph or folder of photographs; may be repeated.",
            show_default="painted images",
        ),
    ] = None,
    most: Annotated[int, typer.Option(min=1, help="Images taken of those, at even distances.")] = 12,
    size: Annotated[int, typer.Option(min=64, max=1024, help="Side of the crops in pixels.")] = 256,
    pca: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Test also with features reduced to so many channels."),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Timed runs; the median counts.")] = 5,
    threads: Annotated[int, typer.Option(min=1, max=256, help="CPU threads of every encoder.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of crops, warps, light and points.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Match an image with itself, warped and in another light: how often the nearest neighbour is right."""
    import json

    import cv2
    import torch

    from tracking3d.cli.tables import print_table
    from tracking3d.results.description import versions
    from tracking3d_bench.benchmark.feature_encoders import (
        build_encoders,
        measure_encoders,
        painted_images,
        read_images,
    )
    from tracking3d_bench.benchmark.matching import make_pairs
    from tracking3d_bench.benchmark.matching_table import format_matching, matching_report

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    encoders = build_encoders(features or [], threads)
    pictures = read_images(images, most) if images else painted_images(seed)
    pairs = make_pairs(pictures, seed, size)
    measured = measure_encoders(encoders, pairs, repeats, pca)
    if as_json:
        problem = {
            "images": [str(path) for path in images or []],
            "pairs": len(pairs),
            "size": size,
            "seed": seed,
            "threads": threads,
            "repeats": repeats,
            "reduced_channels": pca,
            "versions": versions(),
        }
        typer.echo(json.dumps(matching_report(measured, problem)))
        return
    print_table(format_matching(measured, pca))
    kind = "photographs" if images else "painted images"
    typer.echo(
        f"{len(pairs)} pairs of {size} x {size} pixels from {len(pictures)} {kind}, seed {seed}, "
        f"{threads} thread{'s' if threads > 1 else ''}"
    )
