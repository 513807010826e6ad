"""Which photographs are kept for validation: some of every source, whole kinds of objects, and whole sources."""

from __future__ import annotations

import csv
import re
from pathlib import Path

HELD_OUT_SOURCES = ("TheRobotStudio+SO-ARM100", "adafruit+Adafruit_Learning_System_Guides")

HELD_OUT_OBJECTS = re.compile(
    r"Pineapple|Aubergine|Ginger|Oat-?Milk|Sour-?Cream|Tropicana|Kiwi|/projects/(guitar|wallet|duct)",
    re.IGNORECASE,
)
"""In the paths of photographs: things of which none is trained on."""

_EVERY = 16


def held_out(photos: Path) -> dict[str, str]:
    """File below ``photos`` -> ``image``, ``object`` or ``source``, for the photographs that are kept."""
    kept = {}
    with (photos / "index.csv").open(encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            source, name = row["file"].split("/")
            if source in HELD_OUT_SOURCES:
                kept[row["file"]] = "source"
            elif HELD_OUT_OBJECTS.search(row["path in its source"]):
                kept[row["file"]] = "object"
            elif int(name.split(".")[0], 16) % _EVERY == 0:
                kept[row["file"]] = "image"
    return kept
