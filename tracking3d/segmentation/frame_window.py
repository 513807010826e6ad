"""One frame prepared for segmentation: a window at the frame's own resolution, and the surface rendered into it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import NEAR, Camera, Window
from tracking3d.rendering.visibility import rasterize
from tracking3d.scene.view import crop_window, inside_frame
from tracking3d.trackers.crops import box_of

LARGEST = 320
"""Pixels of a window's side; a larger one is seen smaller."""
_MARGIN = 0.2  # beside the masks, relative to their longer side
Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Answered:
    """A frame and what is known of it, through a pinhole camera."""

    index: int  # the index of the frame
    image: Image  # (H, W, 3) RGB
    initial: Mask  # (H, W) the mask tracker's mask
    answer: Mask  # (H, W) the estimated mask
    T_cam_obj: NDArray[np.float64]  # (4, 4); NaN if there is no pose that is trusted
    confidence: float  # the confidence of the pose, in [0, 1]
    occluder: Mask | None = None  # (H, W) what is in front of the object; None if nothing is known


@dataclass(frozen=True, eq=False)
class FrameWindow:
    """A frame, the object's surface at its pose, and where masks say that the object is."""

    window: Window  # of the frame; all planes are (S, S) of it
    image: NDArray[np.uint8]  # (S, S, 3) RGB
    K: NDArray[np.float64]  # (3, 3) intrinsics of the window
    T_cam_obj: NDArray[np.float64]  # (4, 4); NaN if there is no pose
    initial: Mask  # the mask tracker's mask
    answer: Mask  # the estimated mask
    drawn: Mask  # the silhouette; empty without a pose
    inverse_depth: Plane  # of the surface, carried on beyond the silhouette; 0 without a pose
    confidence: float  # the confidence of the pose, in [0, 1]
    valid: Mask  # what lies in the frame
    occluder: Mask | None = None  # what is in front of the object; None if nothing is known

    @classmethod
    def of(
        cls, frame: Answered, camera: Camera, vertices: NDArray[np.float64], faces: NDArray[np.int64]
    ) -> Self | None:
        """A frame seen through the window around its masks; None if both are empty.

        Args:
            frame: The frame.
            camera: The camera of the full frame.
            vertices: ``(V, 3)`` of the object.
            faces: ``(F, 3)``.
        """
        box = box_of(frame.initial | frame.answer)
        if box is None:
            return None
        window = Window.around(box, _MARGIN, 1)
        window = Window(window.left, window.top, window.side, min(window.side, LARGEST))
        valid = inside_frame(frame.initial.shape, window)
        initial, answer = (
            (crop_window(mask, window) > 0.5) & valid for mask in (frame.initial, frame.answer)
        )
        K, T_cam_obj = window.K(camera), frame.T_cam_obj
        drawn, inverse_depth = surface_in(K, T_cam_obj, vertices, faces, window.size)
        image, occluder = crop_window(frame.image, window), None
        if frame.occluder is not None:
            occluder = (crop_window(frame.occluder, window) > 0.5) & valid
        return cls(
            window,
            image,
            K,
            T_cam_obj,
            initial,
            answer,
            drawn & valid,
            inverse_depth,
            frame.confidence,
            valid,
            occluder,
        )


def surface_in(
    K: NDArray[np.float64],
    T_cam_obj: NDArray[np.float64],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    size: int,
) -> tuple[Mask, Plane]:
    """The silhouette ``(S, S)`` and one over its depth, beyond it the nearest pixel's; empty and 0 without a pose."""
    nothing = np.zeros((size, size), bool), np.zeros((size, size), np.float32)
    if not np.isfinite(T_cam_obj).all() or not np.isfinite(vertices).all():
        return nothing
    seen = vertices @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    if (seen[:, 2] <= NEAR).any():
        return nothing
    screen = seen @ K.T
    screen = screen[:, :2] / screen[:, 2:]
    drawn = rasterize(
        torch.tensor(screen, dtype=torch.float32)[None],
        torch.tensor(seen[:, 2], dtype=torch.float32)[None],
        torch.tensor(faces),
        (size, size),
    ).depth[0].numpy()  # fmt: skip
    covered = np.isfinite(drawn)
    if not covered.any():
        return nothing
    _, nearest = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[covered]] = 1 / drawn[covered]
    return covered, by_label[nearest]
