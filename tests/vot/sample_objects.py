"""A short clip and a fast pipeline for the tests of the VOT tracker."""

from __future__ import annotations

from pathlib import Path

from tracking3d.results.files import write_image
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize

QUICK = "crop.size=32 object.frequency=2 object.texture_size=16"


def sample_clip(frames: int = 3) -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=frames, size=(80, 64)))


def write_frames(folder: Path, clip: SyntheticClip) -> list[str]:
    for n, image in enumerate(clip.images):
        write_image(folder / f"{n:08d}.png", image)
    return [str(folder / f"{n:08d}.png") for n in range(len(clip.images))]
