"""A whole synthetic sequence in memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d_bench.synthesis.frame_rendering import RenderedFrame, render_frame
from tracking3d_bench.synthesis.point_tracks import GroundTruthTracks, sample_point_tracks
from tracking3d_bench.synthesis.scene import Scene, make_scene
from tracking3d_bench.synthesis.spec import SequenceSpec


@dataclass(frozen=True, eq=False)
class RenderedSequence:
    """Images and their truth."""

    scene: Scene  # what they show; its `Scene.T_cam_obj` are the poses
    images: NDArray[np.uint8]  # (N, H, W, 3) uint8 RGB, before JPEG compression
    masks: NDArray[np.bool_]  # (N, H, W) bool, the object as if nothing were in front of it
    visible_masks: NDArray[np.bool_]  # (N, H, W) bool
    depth: NDArray[np.float32]  # (N, H, W) float32, z of the object in `masks`; 0 elsewhere
    points: GroundTruthTracks  # surface points and where they are seen


def render_frames(scene: Scene) -> Iterator[RenderedFrame]:
    """Render the frames of a scene in order, one in memory at a time."""
    for frame in range(scene.spec.frames):
        yield render_frame(scene, frame)


def render_sequence(spec: SequenceSpec) -> RenderedSequence:
    """Render a sequence in memory.

    Raises:
        InputError: If its object or background cannot be used, or Embree is not installed.
    """
    scene = make_scene(spec)
    frames = list(render_frames(scene))
    return RenderedSequence(
        scene,
        np.stack([frame.image for frame in frames]),
        np.stack([frame.mask for frame in frames]),
        np.stack([frame.visible_mask for frame in frames]),
        np.stack([frame.depth for frame in frames]),
        sample_point_tracks(scene),
    )
