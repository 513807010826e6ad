"""How many keypoints of two frames of an object are matched rightly, by how far it has turned between them.

python benchmarks/keypoint_matches.py clips/cube_in_hand clips/temple_ring --keypoints sift \
    --keypoints network --keypoints network,model=mine.onnx
"""

from __future__ import annotations

import json
import random
import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from script import run

BUCKETS = ((5, 15), (15, 30), (30, 45), (45, 70))
"""Degrees between the two frames."""

_NEAR = 2.0  # pixels from the true epipolar line within which a match is right
_DRAWS = 30_000  # pairs among which those of a bucket are looked for


def keypoint_matches(
    clips: Annotated[
        list[Path], typer.Argument(help="Folders with frames, masks, poses.json and camera.json.")
    ],
    keypoints: Annotated[list[str], typer.Option(help="NAME or NAME,OPTION=VALUE,... of a plug-in.")],
    pairs: Annotated[int, typer.Option(min=1, help="Pairs of a bucket.")] = 15,
    seed: Annotated[int, typer.Option(help="Which pairs.")] = 1,
) -> None:
    """Print the mean number of right matches a bucket, upright and as filmed, and milliseconds a crop."""
    from tracking3d.config.models import PluginChoice
    from tracking3d.plugins import KEYPOINTS, build_plugin

    cv2.setNumThreads(1)
    for clip in clips:
        frames, K = _read(clip)
        chosen = _pairs(frames, pairs, seed)
        typer.echo(f"{clip.name}: pairs {[len(found) for found in chosen.values()]}")
        for text in keypoints:
            name, *options = text.split(",")
            choice = PluginChoice(name=name, **dict(option.split("=", 1) for option in options))
            detector = build_plugin(KEYPOINTS, choice)
            for upright in (True, False):
                if upright or not detector.rotation_invariant:
                    typer.echo(f"  {text}{'' if upright else ', as filmed'}: ", nl=False)
                    typer.echo(_measure(detector, clip, frames, K, chosen, upright))


def _read(clip: Path) -> tuple[dict[str, tuple[NDArray[Any], NDArray[Any]]], NDArray[Any]]:
    """Rotation and translation of the frames whose poses are trusted, and the intrinsics."""
    poses = json.loads((clip / "poses.json").read_text())["frames"]
    K = np.array(json.loads((clip / "camera.json").read_text())["K"], float).reshape(3, 3)
    frames = {
        name: (np.array(pose["R"]), np.ravel(pose["t"]).astype(float))
        for name, pose in sorted(poses.items())
        if pose.get("trusted", True) and (clip / "masks" / f"{name}.png").is_file()
    }
    return frames, K


def _pairs(frames: dict[str, Any], most: int, seed: int) -> dict[tuple[int, int], list[tuple[str, str]]]:
    drawn, chosen = random.Random(seed), {bucket: list[tuple[str, str]]() for bucket in BUCKETS}
    for _ in range(_DRAWS):
        a, b = drawn.sample(list(frames), 2)
        cosine = (np.trace(frames[b][0] @ frames[a][0].T) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        for (low, high), found in chosen.items():
            if low <= angle < high and len(found) < most:
                found.append((a, b))
    return chosen


def _measure(
    detector: Any, clip: Path, frames: dict[str, Any], K: NDArray[Any], chosen: dict[Any, Any], upright: bool
) -> str:
    from tracking3d.estimation.online.features.sift import detect, match

    seconds, means = list[float](), list[str]()
    for pairs in chosen.values():
        right, all_matches = list[int](), list[int]()
        for a, b in pairs:
            R = frames[b][0] @ frames[a][0].T
            t = frames[b][1] - R @ frames[a][1]
            turn = -np.degrees(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])) if upright else 0.0
            found = []
            for name, angle in ((a, 0.0), (b, turn)):
                image = _read_grey(clip / "frames" / f"{name}.jpg")
                mask = _read_grey(clip / "masks" / f"{name}.png") > 127
                begun = time.process_time()
                found.append(detect(image, mask, detector=detector, turn=float(angle)))
                seconds.append(time.process_time() - begun)
            first, second = found
            pairs_found = match(first, second)
            x, y = first.pixel[pairs_found[:, 0]], second.pixel[pairs_found[:, 1]]
            right.append(int((_off_line(x, y, R, t, K) < _NEAR).sum()))
            all_matches.append(len(pairs_found))
        means.append(f"{np.mean(right):.0f} of {np.mean(all_matches):.0f}" if pairs else "-")
    return f"{', '.join(means)}; {1000 * np.median(seconds):.1f} ms"


def _read_grey(file: Path) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8)


def _off_line(
    x: NDArray[Any], y: NDArray[Any], R: NDArray[Any], t: NDArray[Any], K: NDArray[Any]
) -> NDArray[Any]:
    """``(M,)`` the larger of the distances in pixels of matched places from the epipolar lines of each other."""
    inverse = np.linalg.inv(K)
    F = inverse.T @ np.cross(np.eye(3), t) @ R @ inverse
    x, y = (np.column_stack([pixels, np.ones(len(pixels))]) for pixels in (x, y))
    there, here = x @ F.T, y @ F
    product = np.abs((y * there).sum(1))
    return product / np.minimum(np.hypot(*there[:, :2].T), np.hypot(*here[:, :2].T))


if __name__ == "__main__":
    run(keypoint_matches)
