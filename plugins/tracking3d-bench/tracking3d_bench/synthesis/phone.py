"""Suites of everyday videos of a phone, generated from a seed.

A thing stands on a table for one to three seconds, in a portrait video of a camera that is held in a hand. Then a hand
takes it, lifts it, turns it through at least half a turn with pauses, and puts it down. Nothing was tuned on them.
"""

from __future__ import annotations

import math
import re

import numpy as np

from tracking3d.errors import InputError
from tracking3d_bench.synthesis.pick_up import PICK_UP
from tracking3d_bench.synthesis.spec import Disturbances, SequenceSpec

PHONE = "phone"
"""Name of the suites; with ``-SEED`` it is one of them."""

SIZE = (720, 1280)
"""Width and height in pixels."""

FRAMES_A_SECOND = 30

PRINTS = ("printed", "faint", "plain")
"""Kinds of surface; each comes once with each shape."""

_SHAPES = ("box", "bottle", "mug")  # with each kind of print; the fourth thing is one of the others
_OTHERS = ("wedge", "organic", "assembly", "knob", "bowl", "blob")

_STILL = (30, 90)  # frames
_HANDLED = (120, 128)  # frames from when the hand sets out
_SPEED = (5.2, 6.2)  # mean degrees a frame while the object turns
_FOV = (65.0, 75.0)  # degrees, along the long side
_FILL = {"bottle": (0.3, 0.37)}  # a slender thing seems smaller than the sphere around it
_USUAL_FILL = (0.23, 0.29)


def phone_name(seed: int) -> str:
    """What the suite of a seed is called."""
    return f"{PHONE}-{seed}"


def phone_seed(name: str) -> int | None:
    """The seed of a suite's name ``phone-SEED``; None of other names."""
    named = re.fullmatch(rf"{PHONE}-(\d+)", name)
    return int(named[1]) if named else None


def phone_suite(seed: int) -> list[SequenceSpec]:
    """The twelve sequences of a suite: four printed things, four of faint print and four plain ones.

    Args:
        seed: Not negative; another seed gives other sequences.

    Raises:
        InputError: If the seed is negative.
    """
    if seed < 0:
        raise InputError(f"--seed {seed} is negative; give a number of 0 or more.")
    others = np.random.default_rng([seed, *b"others"]).permutation(_OTHERS).tolist()
    kinds = [
        (shape, kind) for kind, other in zip(PRINTS, others, strict=False) for shape in (*_SHAPES, other)
    ]
    return [_sequence(seed, index, *kind) for index, kind in enumerate(kinds)]


def _sequence(seed: int, index: int, shape: str, kind: str) -> SequenceSpec:
    rng = np.random.default_rng([seed, index, *PHONE.encode()])
    # Squared, so that short rests, which leave a tracker less to learn from, are the more frequent ones.
    still = round(_STILL[0] + (_STILL[1] - _STILL[0]) * rng.random() ** 2)
    label = kind == "faint" and index % 2 == 0
    strength = round(float(rng.uniform(0.12, 0.4)), 3) if kind == "faint" and not label else 1.0
    glossy = bool(rng.random() < 0.4)
    aside = math.radians(rng.uniform(-50, 50))
    lamp = round(math.sin(aside), 3), round(-float(rng.uniform(0.4, 1.1)), 3), round(-math.cos(aside), 3)
    return SequenceSpec(
        name=f"{index:02d}_{shape}_{'label' if label else kind}",
        object=shape,
        textured=kind != "plain" and not label,
        label=label,
        print_strength=strength,
        motion=PICK_UP,
        degrees_per_frame=round(float(rng.uniform(*_SPEED)), 2),
        still_frames=still,
        frames=still + int(rng.integers(_HANDLED[0], _HANDLED[1] + 1)),
        size=SIZE,
        fov=round(float(rng.uniform(*_FOV)), 2),
        camera_told=False,
        fill=round(float(rng.uniform(*_FILL.get(shape, _USUAL_FILL))), 3),
        lamp=lamp,
        disturbances=Disturbances(
            highlights=round(float(rng.uniform(0.1, 0.35)), 2) if glossy else 0.0,
            noise=round(float(rng.uniform(0.04, 0.12)), 3),
            occluder=round(float(rng.uniform(0.6, 1.0)), 2),
            jpeg=round(float(rng.uniform(0.08, 0.2)), 3),
        ),
        seed=int(rng.integers(2**32)),
    )
