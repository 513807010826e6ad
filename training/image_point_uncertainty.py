"""Fit how far points that the images alone follow are off, and test it on clips of other seeds.

::

    python training/image_point_uncertainty.py

The weights that it prints belong into ``tracking3d/points/image_following.py``. They are fitted on points of turning
objects, whose appearance changes; of what lies still before a moving camera the error is then told too large rather
than too small. Both are tested. Quantile regression, as in ``training/point_uncertainty.py``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import cv2
import numpy as np
from point_uncertainty import fit

from tracking3d.points.image_following import follow_in_images, image_error_features
from tracking3d.points.pictures import Picture, open_picture
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.testing.synthesis.procedural_texture import paint_background

SIZE = (320, 240)
FRAMES = 24
POINTS = 150
FITTED, TESTED = range(100, 118), range(200, 218)

Case = tuple[list[Picture], np.ndarray, np.ndarray, np.ndarray]
"""Pictures, pixels of the first one, true positions ``(T, N, 2)`` and visibility ``(T, N)``."""


def turning(seed: int) -> Case:
    """Points of an object that turns by one to six degrees a frame."""
    shape: Literal["box", "chamfered_box"] = "box" if seed % 2 else "chamfered_box"
    clip = synthesize(
        SyntheticSpec(shape=shape, frames=FRAMES, size=SIZE, degrees_per_frame=1.0 + seed % 6, seed=seed)
    )
    rng = np.random.default_rng(seed)
    x, y, width, height = clip.box
    xy = rng.uniform((x, y), (x + width, y + height), (POINTS, 2))
    inner = cv2.erode(clip.masks[0].astype(np.uint8), np.ones((5, 5), np.uint8))
    xy = xy[inner[xy[:, 1].astype(int), xy[:, 0].astype(int)] > 0]
    normals, offsets = clip.surface.normals, clip.surface.offsets
    centre, focal = clip.K[:2, 2], np.diag(clip.K)[:2]
    first = clip.T_cam_obj[0]
    direction = np.column_stack([(xy - centre) / focal, np.ones(len(xy))]) @ first[:3, :3]
    eye = -first[:3, :3].T @ first[:3, 3]
    along = direction @ normals.T
    enter = np.where(along < 0, (offsets - normals @ eye) / along, -np.inf)
    points, side = eye + enter.max(1)[:, None] * direction, enter.argmax(1)
    tracks, visible = [], []
    for T in clip.T_cam_obj:
        seen = points @ T[:3, :3].T + T[:3, 3]
        tracks.append(seen[:, :2] / seen[:, 2:] * focal + centre)
        ray = -T[:3, :3].T @ T[:3, 3] - points
        visible.append((ray * normals[side]).sum(1) / np.linalg.norm(ray, axis=1) > 0.05)
    pictures = [open_picture(image, mask) for image, mask in zip(clip.images, clip.masks, strict=True)]
    return pictures, xy, np.stack(tracks), np.stack(visible)


def passing(seed: int) -> Case:
    """Points of a picture that turns, grows and passes by."""
    rng = np.random.default_rng(seed)
    width, height = SIZE
    large = paint_background(rng, 2 * width, 2 * height, 1.0).astype(np.float32)
    turn, growth, pan = rng.uniform(-1.5, 1.5), rng.uniform(-0.01, 0.01), rng.uniform(-3, 3, 2)
    xy = rng.uniform((5, 5), (width - 5, height - 5), (POINTS, 2))
    points, tracks, visible, pictures = xy, [], [], []
    for frame in range(FRAMES):
        M = cv2.getRotationMatrix2D((width, height), turn * frame, float(np.exp(growth * frame)))
        M[:, 2] += pan * frame - np.array(SIZE) / 2
        if not frame:
            back = cv2.invertAffineTransform(M)
            points = xy @ back[:, :2].T + back[:, 2]
        image = cv2.warpAffine(large, M, SIZE) + 2.0 * rng.standard_normal((height, width, 3))
        pictures.append(open_picture(image.clip(0, 255).astype(np.uint8), np.zeros((height, width), bool)))
        tracks.append(points @ M[:, :2].T + M[:, 2])
        visible.append(((tracks[-1] > 0) & (tracks[-1] < np.array(SIZE) - 1)).all(1))
    return pictures, xy, np.stack(tracks), np.stack(visible)


def collected(cases: Iterator[Case]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Of each case: features, errors, which points were found, and twice the uncertainty that is told today."""
    for pictures, xy, tracks, visible in cases:
        found = follow_in_images(pictures, 0, xy)
        error = np.linalg.norm(found.positions - tracks, axis=2)
        counts = visible.copy()
        counts[0] = False
        gap = np.arange(len(pictures))
        hidden = np.zeros(visible.shape)
        for row in range(1, len(gap)):
            hidden[row] = np.where(found.visible[row], 0, hidden[row - 1] + 1)
        known = image_error_features(found.variance, np.broadcast_to(gap[:, None], visible.shape), hidden)
        yield known[counts], error[counts], found.visible[counts], 2 * found.uncertainty[counts]


if __name__ == "__main__":
    cv2.setNumThreads(1)
    parts = collected(turning(seed) for seed in FITTED)
    known, error, seen, _ = (np.concatenate(part) for part in zip(*parts, strict=True))
    for name, chosen in (("FOUND", seen), ("NOT_FOUND", ~seen)):
        print(name, "=", tuple(round(float(one), 3) for one in fit(known[chosen], error[chosen])))
    for name, make in (("turning", turning), ("passing", passing)):
        shares = [
            float(np.mean(error <= twice)) for _, error, _, twice in collected(make(seed) for seed in TESTED)
        ]
        print(f"{name}: inside twice the uncertainty of today, mean {np.mean(shares):.3f},", end=" ")
        print(f"least {min(shares):.3f} of {len(shares)} clips")
