"""What many tests ask for and what takes long, such as the same synthetic clip, is made once in a process."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Hashable
from typing import Any, ClassVar

import numpy as np

from tracking3d.synthesis import convex_clips, scene
from tracking3d.trackers import first_mask


class MadeOnce:
    """A function that computes nothing twice; every caller has a copy of his own.

    Args:
        function: Whose result depends on nothing but its arguments.
        key: Of the same arguments, what the result depends on.
    """

    anew: ClassVar[bool] = False
    """Compute everything twice all the same; see the fixture `made_anew`."""

    def __init__(self, function: Callable[..., Any], key: Callable[..., Hashable]) -> None:
        self._function, self._key = function, key
        self._made: dict[Hashable, Any] = {}

    def __call__(self, *arguments: Any) -> Any:
        if self.anew:
            return self._function(*arguments)
        key = self._key(*arguments)
        if key not in self._made:
            self._made[key] = self._function(*arguments)
        return copy.deepcopy(self._made[key])


def make_once() -> None:
    """Let it be so for GrabCut, the synthetic clips and the procedural objects."""
    first_mask._grab_cut = MadeOnce(first_mask._grab_cut, _of_bytes)
    convex_clips.synthesize = MadeOnce(convex_clips.synthesize, lambda spec: spec)
    scene.make_procedural_solid = MadeOnce(
        scene.make_procedural_solid,
        lambda spec: (spec.object, spec.textured, spec.print_strength == 0, spec.seed),
    )


def _of_bytes(*arguments: Any) -> Hashable:
    return tuple(
        (one.shape, hashlib.sha256(np.ascontiguousarray(one)).digest())
        if isinstance(one, np.ndarray)
        else one
        for one in arguments
    )
