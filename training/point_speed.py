"""What a thousand points cost a frame on one core.

::

    python training/point_speed.py

To compare two versions, run it in the checkout of each, by turns.
"""

from __future__ import annotations

import time

import cv2
import numpy as np
import torch
import trimesh
from scipy.spatial import HalfspaceIntersection

from tracking3d.points.follow import follow_points
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.points.view import open_view
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize

FRAMES, POINTS, TURNS = 24, 1000, 7


def main() -> None:
    """Follow points through an object that turns by two degrees a frame and fills the picture."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    clip = synthesize(
        SyntheticSpec(frames=FRAMES, size=(640, 480), degrees_per_frame=2.0, supersample=1, fill=1.0)
    )
    planes = np.column_stack([clip.surface.normals, -clip.surface.offsets])
    solid = trimesh.convex.convex_hull(HalfspaceIntersection(planes, np.zeros(3)).intersections)
    surface = np.asarray(solid.vertices), np.asarray(solid.faces)
    views = [
        open_view(image, mask, clip.camera, T, *surface)
        for image, mask, T in zip(clip.images, clip.masks, clip.T_cam_obj, strict=True)
    ]
    scene = LandmarkScene(list(views), *surface)
    rows, columns = np.nonzero(clip.masks[0])
    chosen = np.random.default_rng(0).choice(len(rows), POINTS, replace=False)
    xy = np.stack([columns[chosen], rows[chosen]], 1).astype(float)
    seconds = []
    for _ in range(TURNS):
        start = time.perf_counter()
        found = follow_points(scene, 0, xy)
        seconds.append(time.perf_counter() - start)
    window = None if scene.views[0] is None else scene.views[0].image.shape
    print(
        f"{1000 * np.median(seconds[1:]) / FRAMES:.1f} ms a frame for {POINTS} points in windows of {window};",
        end=" ",
    )
    print(f"the image had a say in {found.measured.mean():.2f} of them")


if __name__ == "__main__":
    main()
