"""Names for what a result depends on, so that it is computed once: code, settings, frames."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import tracking3d
from tracking3d.plugins import list_plugins
from tracking3d.results.description import versions
from tracking3d_bench.benchmark.variant import DEGRADED, HAND, NOISE
from tracking3d_bench.datasets.truth import Truth

PACKAGE, BENCH = Path(tracking3d.__file__).parent, Path(__file__).parents[1]
JUDGES = frozenset({"datasets", "evaluation"})
"""Rooms of `BENCH` that scores depend on, and runs do not."""

BYSTANDERS = frozenset({"cli", "synthesis"})
"""Rooms of `PACKAGE` that neither depends on."""


@cache
def code_fingerprint(*, judges: bool) -> str:
    """Hash of the sources that scores depend on, or of those that runs depend on, and of the versions they run with."""
    digest = hashlib.sha256(json.dumps(versions(), sort_keys=True).encode())
    for inside, path in hashed_sources(judges=judges):
        digest.update(inside.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def hashed_sources(*, judges: bool) -> list[tuple[str, Path]]:
    """The files of `code_fingerprint`, each with its path inside its package."""
    home = BENCH if judges else PACKAGE
    found = [
        (path.relative_to(home), path) for path in sorted(home.rglob("*")) if path.suffix in (".py", ".yaml")
    ]
    return [
        (inside.as_posix(), path)
        for inside, path in found
        if (inside.parts[0] in JUDGES if judges else inside.parts[0] not in BYSTANDERS)
    ]


def frames_fingerprint(truth: Truth) -> str:
    """Hash of the names and sizes of a clip's frames and of the contents of the first and the last."""
    digest = hashlib.sha256()
    for path in truth.frames:
        digest.update(f"{path.name} {path.stat().st_size}\n".encode())
    for path in (truth.frames[0], truth.frames[-1]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def masks_fingerprint(masks: str, sequence: str) -> str:
    """What the initial masks of a source depend on beside the frames: a folder's files, the code that degrades."""
    if masks.startswith(DEGRADED):
        return hashlib.sha256((BENCH / "synthesis/mask_degradation.py").read_bytes()).hexdigest()
    if masks.startswith(NOISE) or masks == HAND:
        return hashlib.sha256((BENCH / "synthesis/mask_noise.py").read_bytes()).hexdigest()
    folder = Path(masks) / sequence
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    return key(*((file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files))


def plugin_versions(*names: str) -> list[tuple[str, str, str]]:
    """Name, package and version of the plug-ins called ``names``: others' code is not among the hashed sources."""
    known = (info for info in list_plugins() if info.name in names and info.status == "ok")
    return sorted((info.name, info.package, info.version) for info in known)


def key(*parts: Any) -> str:
    """Hash of parts that JSON can hold."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()
