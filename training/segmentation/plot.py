"""Draw a training: ``python training/segmentation/plot.py OUT curve.svg``; needs matplotlib."""

from __future__ import annotations

import csv
import sys
from pathlib import Path


def plot(out: Path, picture: Path) -> None:
    """Draw the losses, and the measures of validation below them."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, (above, below) = pyplot.subplots(2, 1, figsize=(7, 6), sharex=True)
    losses = _columns(out / "losses.csv")
    for name in ("object", "occluder"):
        above.plot(losses["step"], losses[name], label=f"loss of the {name}")
    above.set_ylabel("loss")
    above.legend()
    if (out / "validation.csv").exists():
        measures = _columns(out / "validation.csv")
        for name in ("still_box", "still_all", "composed_all", "front_box", "front_all", "occluder_all"):
            below.plot(measures["step"], measures[name], marker=".", label=name.replace("_", ", "))
        below.legend(fontsize="small", ncols=2)
    below.set_xlabel("step")
    below.set_ylabel("held-out mean IoU")
    figure.tight_layout()
    figure.savefig(picture, metadata={"Date": None} if picture.suffix == ".svg" else None)


def _columns(file: Path) -> dict[str, list[float]]:
    with file.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("Usage: python training/segmentation/plot.py OUT PICTURE.svg")
    plot(Path(sys.argv[1]), Path(sys.argv[2]))
