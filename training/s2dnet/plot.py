"""Draw the losses of a training: ``python training/s2dnet/plot.py OUT/losses.csv losses.svg``; needs matplotlib."""

from __future__ import annotations

import csv
import sys
from pathlib import Path


def plot(table: Path, picture: Path) -> None:
    """Draw the matching and distillation losses, and the share of points that are found."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    with table.open(encoding="utf-8") as stream:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(stream)]
    steps = [row["step"] for row in rows]
    figure, axes = pyplot.subplots(figsize=(7, 3.5))
    for name, label in (("matching", "matching loss"), ("distillation", "distillation loss")):
        axes.plot(steps, [row[name] for row in rows], label=label)
    share = axes.twinx()
    share.plot(steps, [100 * row["found"] for row in rows], color="tab:green", label="found [%]")
    axes.set_xlabel("step")
    axes.set_ylabel("loss")
    share.set_ylabel("points found [%]")
    lines = [*axes.get_lines(), *share.get_lines()]
    axes.legend(lines, [line.get_label() for line in lines], loc="center right")
    figure.tight_layout()
    figure.savefig(picture, metadata={"Date": None} if picture.suffix == ".svg" else None)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("Usage: python training/s2dnet/plot.py LOSSES.csv PICTURE.svg")
    plot(Path(sys.argv[1]), Path(sys.argv[2]))
