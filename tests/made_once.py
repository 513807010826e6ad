"""What many tests ask for and what takes long, such as the same synthetic clip, is made once in a test run.

That is once for all workers: what one of them has made, the others find in the run's folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import torch

from tracking3d.estimation.online import refiner
from tracking3d.estimation.online.initialization import pending_frames
from tracking3d.testing.synthesis import convex_clips
from tracking3d.trackers import first_mask
from tracking3d_bench.benchmark import feature_encoders
from tracking3d_bench.synthesis import ray_casting, scene


class MadeOnce:
    """A function that computes nothing twice; every caller has a copy of his own.

    Args:
        function: Whose result depends on nothing but its arguments; both can be pickled.
        key: Of the same arguments, what the result depends on.
    """

    anew: ClassVar[bool] = False
    """Compute everything twice all the same; see the fixture `made_anew`."""
    folder: ClassVar[Path | None] = None
    """Where workers leave what they have made for the others."""

    def __init__(self, function: Callable[..., Any], key: Callable[..., Any] = lambda *given: given) -> None:
        self._function, self._key = function, key
        self._made: dict[str, bytes] = {}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if self.anew:
            return self._function(*arguments, **named)
        name = self._name((self._key(*arguments), sorted(named.items())))
        if name not in self._made:
            self._made[name] = self._find(name) or self._kept(name, self._function(*arguments, **named))
        return pickle.loads(self._made[name])

    def _name(self, key: Any) -> str:
        told = io.BytesIO()
        told.write(f"{self._function.__module__}.{self._function.__qualname__}:".encode())
        _BitsOfTensors(told).dump(key)
        return hashlib.sha256(told.getbuffer()).hexdigest()

    def _find(self, name: str) -> bytes | None:
        if self.folder is not None:
            with contextlib.suppress(FileNotFoundError):
                return (self.folder / name).read_bytes()
        return None

    def _kept(self, name: str, result: Any) -> bytes:
        data = pickle.dumps(result)
        if self.folder is not None:
            with tempfile.NamedTemporaryFile(dir=self.folder, delete=False) as file:
                file.write(data)
            Path(file.name).replace(self.folder / name)
        return data


class _BitsOfTensors(pickle.Pickler):
    """Writes the same for the same tensors; torch itself writes where they lie in memory, too."""

    def reducer_override(self, value: Any) -> Any:
        if type(value) is not torch.Tensor:
            return NotImplemented
        if value.layout == torch.sparse_coo:
            return torch.sparse_coo_tensor, (
                value.coalesce().indices(),
                value.coalesce().values(),
                value.shape,
            )
        return torch.as_strided, (value.detach().numpy(), value.stride(), value.requires_grad)


def make_once() -> None:
    """Let it be so for GrabCut, painted images, synthetic clips and solids, and starts and maps that a run solves."""
    feature_encoders.painted_images = MadeOnce(feature_encoders.painted_images)
    first_mask._grab_cut = MadeOnce(first_mask._grab_cut)
    convex_clips.synthesize = MadeOnce(convex_clips.synthesize)
    scene.make_procedural_solid = MadeOnce(
        scene.make_procedural_solid,
        lambda spec: (spec.object, spec.textured, spec.print_strength == 0, spec.seed),
    )
    ray_casting._corner_normals = MadeOnce(ray_casting._corner_normals, lambda *mesh: mesh[:2])
    pending_frames.solve_start = MadeOnce(pending_frames.solve_start)
    refiner.refine_globally = MadeOnce(refiner.refine_globally)
