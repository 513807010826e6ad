"""Suites on which nothing was tuned: every sequence is generated from a seed.

Object, motion, lens and so on are dealt from decks of cards that are shuffled by the seed, one deck after the other:
each kind comes as often as it is in the deck, and any two dozen sequences in a row hold every one. What the cards leave
open is drawn for each sequence by itself, so that a longer suite begins with the shorter one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from tracking3d.errors import InputError
from tracking3d_bench.synthesis.spec import Disturbances, SequenceSpec

FRESH = "fresh"
"""Name of the suites; with ``-SEED`` it is one of them."""

COUNT = 24
"""Default number of sequences of a suite."""

MESHES = (".obj", ".ply", ".stl", ".glb", ".gltf", ".off")
"""Suffixes of mesh files that are searched in a folder."""

NARROWEST, WIDEST = 8.0, 75.0
"""Vertical fields of view in degrees."""

_MOST = 1000  # sequences; their names have three digits

# What is dealt; a card that is there twice comes twice as often.
OBJECTS = ("organic", "assembly", "stick", "knob", "bowl", "organic", "assembly", "knob")

# The motions with their slowest and fastest rotation in degrees a frame; `flip` and `fast` name the mean and
# the peak.
_SPEEDS = {
    "tumble": (2.0, 6.0),
    "turntable": (3.0, 9.0),
    "turn_and_back": (3.0, 8.0),
    "flip": (3.0, 7.0),
    "fast": (10.0, 35.0),
    "depth_drift": (2.0, 5.0),
    "leave_and_return": (2.0, 5.0),
    "walk_round": (1.6, 3.8),
}
MOTIONS = (*_SPEEDS, "tumble", "turntable", "walk_round", "walk_round")

_LENSES = 12  # strata of equal ratio
_PRINTS = ("strong", "strong", "strong", "faint", "faint", "plain")
_DISTURBED = (0, 0, 0, 1, 2)

# From where a disturbance is noticed to where hardly more of it is filmed.
_STRENGTHS = {
    "light": (0.3, 1.0),
    "highlights": (0.3, 1.0),
    "motion_blur": (0.3, 1.0),
    "noise": (0.1, 0.6),
    "low_contrast": (0.2, 0.6),
    "occluder": (0.4, 1.0),
    "jpeg": (0.3, 0.9),
}

_Card = TypeVar("_Card")


def fresh_name(seed: int, meshes: Path | None = None) -> str:
    """What the suite of a seed is called, with the name of the folder of meshes if there is one."""
    return f"{FRESH}-{seed}" + (f"-{_plain(meshes.resolve().name)}" if meshes else "")


def seed_of(name: str) -> int | None:
    """The seed of a suite's name ``fresh-SEED``; None of other names."""
    named = re.fullmatch(rf"{FRESH}-(\d+)", name)
    return int(named[1]) if named else None


def fresh_suite(seed: int, count: int = COUNT, meshes: Path | None = None) -> list[SequenceSpec]:
    """Draw the sequences of a suite.

    Args:
        seed: Not negative; another seed gives other sequences.
        count: How many. A longer suite begins with the shorter one.
        meshes: Folder of mesh files, also in folders within it; about a third of the sequences then show one of
            them.

    Raises:
        InputError: If seed or count make no sense, or the folder holds no mesh file.
    """
    if seed < 0:
        raise InputError(f"--seed {seed} is negative; give a number of 0 or more.")
    if not 1 <= count <= _MOST:
        raise InputError(f"--count {count} is not between 1 and {_MOST} sequences.")
    files = _mesh_files(meshes) if meshes else []
    cards = (*OBJECTS, *[None] * (len(OBJECTS) // 2 if files else 0))
    kinds = [_dealt(seed, "object", index, cards) for index in range(count)]
    specs = []
    for index, kind in enumerate(kinds):
        shown = (kind, kind) if kind else _dealt(seed, "mesh", kinds[:index].count(None), files)
        specs.append(_sequence(seed, index, *shown))
    return specs


def _dealt(seed: int, purpose: str, index: int, cards: Sequence[_Card]) -> _Card:
    """The card that comes as number ``index`` from decks of all the ``cards``, each deck shuffled again."""
    deck, place = divmod(index, len(cards))
    order = np.random.default_rng([seed, deck, *purpose.encode()]).permutation(len(cards))
    return cards[order[place]]


def _sequence(seed: int, index: int, called: str, shown: str) -> SequenceSpec:
    def dealt(purpose: str, cards: Sequence[_Card]) -> _Card:
        return _dealt(seed, purpose, index, cards)

    rng = np.random.default_rng([seed, index])
    motion = dealt("motion", MOTIONS)
    stratum = dealt("lens", range(_LENSES))
    fov = NARROWEST * (WIDEST / NARROWEST) ** ((stratum + rng.random()) / _LENSES)
    told = dealt("told", (True, False))
    printed = dealt("print", _PRINTS)
    hard = rng.permutation(list(_STRENGTHS))[: dealt("disturbances", _DISTURBED)].tolist()
    disturbances = {name: round(float(rng.uniform(*_STRENGTHS[name])), 2) for name in hard}
    words = [f"{index:02d}", called, motion, f"fov{fov:.0f}", "told" if told else "untold"]
    return SequenceSpec(
        name="_".join(words),
        object=shown,
        textured=printed != "plain",
        print_strength=round(float(rng.uniform(0.12, 0.4)), 3) if printed == "faint" else 1.0,
        motion=motion,
        degrees_per_frame=round(float(rng.uniform(*_SPEEDS[motion])), 2),
        fov=round(fov, 2),
        camera_told=told,
        fill=round(float(rng.uniform(0.5, 0.7)), 3),
        lamp=_lamp(rng),
        disturbances=Disturbances(**disturbances),
        seed=int(rng.integers(2**32)),
    )


def _lamp(rng: np.random.Generator) -> tuple[float, float, float]:
    """A direction above the object and, by 75 degrees at most, to the side of the camera."""
    aside = math.radians(rng.uniform(-75, 75))
    up = rng.uniform(0.3, 1.2)
    return round(math.sin(aside), 3), round(-up, 3), round(-math.cos(aside), 3)


def _mesh_files(folder: Path) -> list[tuple[str, str]]:
    """Names of their own for the mesh files of a folder, and their paths, in order."""
    if not folder.is_dir():
        raise InputError(f"--meshes {folder} is not a folder; give a folder with mesh files.")
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in MESHES and file.is_file())
    if not files:
        raise InputError(f"--meshes {folder} holds no mesh file ({', '.join(MESHES)}); give another folder.")
    return [(_plain("_".join(file.relative_to(folder).with_suffix("").parts)), str(file)) for file in files]


def _plain(name: str) -> str:
    """A name as names of folders may be."""
    return re.sub(r"[^A-Za-z0-9-]+", "_", name).strip("_") or "mesh"
