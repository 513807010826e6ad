"""Videos that are cut off, damaged, or none at all."""

from __future__ import annotations

import shutil

from damaging import ODD_NAMES, damaged, pick, spoil, word
from judging import Case


def videos(case: Case) -> None:
    """Track a spoiled video, or a sound one under an odd name or selection."""
    random = case.random
    suffix = pick(random, ["mp4", "mp4", "avi", "gif"])
    video = case.material.copy(f"clip.{suffix}", case.folder)
    kind = int(random.integers(10))
    if kind < 6:
        case.story.append(spoil(video, random))
    elif kind == 6:
        video = video.rename(case.folder / f"{pick(random, ODD_NAMES)}.{suffix}")
    elif kind == 7:  # another kind of file under the name of a video
        shutil.copy(case.material.folder / pick(random, ["mesh.glb", "masks.npz", "tiny.yaml"]), video)
    elif kind == 8:  # twice the same file, the second time damaged
        video.write_bytes(video.read_bytes() + damaged(video.read_bytes(), random))
    else:
        case.run(video, "--frames", word(random))
        return
    case.run(video)
