"""Collect the photographs of ``sources.yaml``: ``python training/segmentation/collect.py MIRROR DEBIAN OUT``.

Every distinct photograph goes to ``OUT/SOURCE/KEY.jpg``, at most `LONGEST_SIDE` pixels long; ``OUT/index.csv`` says
where each came from. Drawings, screenshots and tiny pictures are left out. What is there already is not made again.
"""

from __future__ import annotations

import csv
import hashlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

Image = NDArray[np.uint8]

LONGEST_SIDE = 640
SHORTEST_SIDE = 180
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
MAX_FLAT = 0.3
"""Share of pixels equal to their right neighbour: drawings have more."""

MIN_DETAIL = 2.0
"""Mean absolute difference of neighbouring grey values at 256 pixels: fog and plain gradients have less."""


def main(mirror: Path, debian: Path, out: Path) -> None:
    """Collect all sources."""
    sources = yaml.safe_load((Path(__file__).parent / "sources.yaml").read_text(encoding="utf-8"))
    out.mkdir(parents=True, exist_ok=True)
    seen: set[bytes] = set()
    rows = []
    for source in sources:
        name = source.get("repository", source.get("package")).replace("/", "+")
        if "repository" in source:
            files = _files_of_repository(mirror / name, source["paths"], mixed="most" in source)
        else:
            files = _files_of_package(debian / name)
        kept, most = 0, source.get("most", sys.maxsize)
        for path, data in files:
            if kept == most:
                break
            key = hashlib.sha1(data).hexdigest()[:12]
            target = out / name / f"{key}.jpg"
            image = cv2.imread(str(target)) if target.exists() else _photograph(data)
            if image is None or not _is_new(image, seen):
                continue
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(target), image, [cv2.IMWRITE_JPEG_QUALITY, 93])
            rows.append(
                (f"{name}/{key}.jpg", path, source["licence"], "yes" if source.get("teach", True) else "no")
            )
            kept += 1
        print(f"{kept:5d}  {name}", flush=True)
    with (out / "index.csv").open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([("file", "path in its source", "licence", "teach"), *rows])


def _files_of_repository(folder: Path, paths: str, mixed: bool) -> Iterator[tuple[str, bytes]]:
    """Paths and contents, in the repository's order or ``mixed``."""
    git_dir = next((d for d in (folder / "repo" / ".git", folder / "repo") if d.is_dir()), None)
    if git_dir is None:
        print(f"       {folder} is missing", flush=True)
        return
    git = ["git", f"--git-dir={git_dir}"]
    listing = subprocess.run([*git, "ls-tree", "-r", "-z", "HEAD"], capture_output=True, check=True).stdout
    entries = listing.decode("utf-8", "replace").split("\0")
    if mixed:
        np.random.default_rng(0).shuffle(entries)
    with subprocess.Popen(
        [*git, "cat-file", "--batch"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as reader:
        assert reader.stdin is not None and reader.stdout is not None
        for entry in entries:
            about, _, path = entry.partition("\t")
            if not path.lower().endswith(SUFFIXES) or not re.search(paths, path):
                continue
            reader.stdin.write(about.split()[2].encode() + b"\n")
            reader.stdin.flush()
            header = reader.stdout.readline().split()
            if header[1] == b"blob":
                yield path, reader.stdout.read(int(header[2]))
                reader.stdout.read(1)


def _files_of_package(folder: Path) -> Iterator[tuple[str, bytes]]:
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() in SUFFIXES and file.is_file() and not file.is_symlink():
            yield str(file.relative_to(folder)), file.read_bytes()


def _photograph(data: bytes) -> Image | None:
    """The picture as BGR thumbnail; None if it is no photograph."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if (
        image is None
        or min(image.shape[:2]) < SHORTEST_SIDE
        or max(image.shape[:2]) > 4 * min(image.shape[:2])
    ):
        return None
    flat = (image[:, 1:] == image[:, :-1]).all(2).mean()
    scale = LONGEST_SIDE / max(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (256, 256)).astype(np.float32)
    detail = sum(np.abs(np.diff(grey, axis=axis)).mean() for axis in (0, 1))
    return None if flat > MAX_FLAT or detail < MIN_DETAIL else image


def _is_new(image: Image, seen: set[bytes]) -> bool:
    small = cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (12, 12), interpolation=cv2.INTER_AREA)
    key = (small > small.mean()).tobytes()
    if key in seen:
        return False
    seen.add(key)
    return True


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit("Usage: python training/segmentation/collect.py MIRROR DEBIAN OUT")
    main(*map(Path, sys.argv[1:]))
