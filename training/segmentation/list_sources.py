"""Write ``SOURCES.md``: ``python training/segmentation/list_sources.py PHOTOS MASKS HAND_MASKS``."""

from __future__ import annotations

import csv
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import yaml

_HEAD = """# Sources of the photographs

`collect.py` fetched what `sources.yaml` names and kept every distinct photograph, at most 640 pixels long; drawings,
screenshots and near copies are left out. Repositories are on GitHub, each at its newest commit in November 2026;
packages are Debian's. Nothing of it is committed. Licences are those that the source states for its pictures, or for
the whole repository. `list_sources.py` writes this page.

"Masks" are the things that the teacher (MobileSAM, Apache-2.0) was sure of, in as many photographs as it has been
asked about; "hands" are those whose points MediaPipe's networks (Apache-2.0) found and whose mask the teacher was sure
of. Sources that it is not asked about serve as backgrounds, or for their hands alone.

| source | licence | what it shows | photographs | asked | masks | hands |
|---|---|---|---|---|---|---|
"""

_FOOT = """
Validation keeps {kept} of the photographs apart (`split.py`): one in sixteen of every source, some kinds of things, and
two whole sources. Data that the product is judged on (DAVIS, BOP, HO3D, YCBInEOAT and the repositories of test clips)
are not among the sources.

The weights that this training began with are of an earlier collection, listed in `SOURCES_FIRST.md`.
"""


def main(photos: Path, masks: Path, hand_masks: Path) -> None:
    """Count, and write the page beside this file."""
    from split import held_out

    here = Path(__file__).parent
    sources = yaml.safe_load((here / "sources.yaml").read_text(encoding="utf-8"))
    with (photos / "index.csv").open(encoding="utf-8") as stream:
        counts = Counter(row["file"].split("/")[0] for row in csv.DictReader(stream))
    rows, totals = [], np.zeros(4, int)
    for source in sources:
        title = source.get("repository", source.get("package"))
        name = title.replace("/", "+")
        asked, found = _count(masks / name)
        _, hands = _count(hand_masks / name)
        numbers = counts[name], asked, found, hands
        if counts[name]:
            totals += numbers
            shown = " | ".join(str(number) for number in numbers)
            rows.append(f"| {title} | {source['licence']} | {source['shows']} | {shown} |")
    total = " | ".join(str(number) for number in totals)
    page = (
        _HEAD + "\n".join([*rows, f"| all | | | {total} |"]) + "\n" + _FOOT.format(kept=len(held_out(photos)))
    )
    (here / "SOURCES.md").write_text(page, encoding="utf-8")


def _count(folder: Path) -> tuple[int, int]:
    """Mask files in a folder, and masks in them."""
    files = [file for file in folder.glob("*.npz") if not file.name.endswith(".part.npz")]
    masks = 0
    for file in files:
        with np.load(file) as data:
            masks += len(data["quality"])
    return len(files), masks


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit("Usage: python training/segmentation/list_sources.py PHOTOS MASKS HAND_MASKS")
    main(*map(Path, sys.argv[1:]))
