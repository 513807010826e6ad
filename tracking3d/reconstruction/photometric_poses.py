"""Poses fitted once more, to the surface at hand at the views' resolution.

Each view is compared with what all of them together show of the surface: a few Levenberg-Marquardt steps on colours
within the mask and on the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from tracking3d.geometry.levenberg_marquardt import Damping, minimizer
from tracking3d.reconstruction.meshing import cell_atlas
from tracking3d.rendering import (
    BackProjection,
    NormalEquations,
    PoseTarget,
    Scales,
    Surface,
    TexelMap,
    back_project,
    pose_terms,
)
from tracking3d.runtime.progress import report_each
from tracking3d.scene.surface import camera_tensors, image_tensor
from tracking3d.scene.view import ObjectView

COLOUR, OUTLINE = 0.1, 2.0
"""Difference of colours in [0, 1], and pixels, from which on a disagreement counts less."""
OUTLINE_WEIGHT = 0.3
_STEPS = 6
_FARTHEST = 5.0  # degrees a pose may turn; a view that turns farther is rejected


def coloured_surface(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], views: Sequence[ObjectView]
) -> Surface:
    """The surface with the mean of what the views show of it.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        views: The frames.
    """
    face_uvs, size = cell_atlas(len(faces))
    uvs = torch.from_numpy(face_uvs).float()
    points, corners = torch.from_numpy(vertices).float(), torch.from_numpy(faces)
    texels = TexelMap.of(uvs, size)
    seen = BackProjection(torch.zeros(3, size, size), torch.zeros(size, size))
    for view in views:
        R, t, K = (part[0] for part in camera_tensors(view))
        # A pixel or two within the outline colours are mixed with the background's.
        valid = torch.from_numpy(np.clip((view.signed_distance - 1) / 2, 0, 1))
        seen = seen + back_project(image_tensor(view), valid, points, corners, texels, R, t, K)
    # Between the cells texels continue the nearest one on a face: samples at a face's edge mix with them.
    uncovered = np.ones((size, size), np.bool_)
    uncovered.flat[texels.texel.numpy()] = False
    row, column = distance_transform_edt(uncovered, return_distances=False, return_indices=True)
    texture = seen.mean()[:, row, column].contiguous()
    known = (seen.weight > 0)[row, column][None].float()
    return Surface(points, corners, uvs, texture, known)


def refine_views(surface: Surface, views: Sequence[ObjectView]) -> list[ObjectView]:
    """The views with poses that fit the surface better.

    Args:
        surface: From `coloured_surface`.
        views: The frames.
    """
    return [
        replace(view, T_cam_obj=_fit_pose(surface, view)) for view in report_each("testing the shape", views)
    ]


@dataclass(frozen=True, eq=False)
class _Pose:
    pose: NDArray[np.float64]  # (4, 4)
    model: NormalEquations  # of colours and outline there
    cost: float


def _fit_pose(surface: Surface, view: ObjectView) -> NDArray[np.float64]:
    """``(4, 4)`` the pose that fits best, the present one if none fits better or it runs away."""
    mask = torch.from_numpy(view.mask)
    target = PoseTarget(
        torch.from_numpy(view.K).float(),
        image_tensor(view),
        mask.float(),
        torch.from_numpy(view.in_frame),
        mask,
        torch.from_numpy(-view.signed_distance),
    )
    first = view.T_cam_obj

    def evaluated(pose: NDArray[np.float64]) -> _Pose:
        R, t = torch.from_numpy(pose[None, :3, :3]).float(), torch.from_numpy(pose[None, :3, 3]).float()
        terms = pose_terms(surface, target, R, t, None, Scales(COLOUR, OUTLINE, 1.0))
        model = terms.appearance + terms.outline * OUTLINE_WEIGHT
        return _Pose(pose, model, float(model.cost[0]))

    def stepped(_: None, at: _Pose, model: NormalEquations, damping: float) -> _Pose:
        step = model.step(damping)[0].numpy()
        trial = at.pose.copy()
        trial[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ at.pose[:3, :3]
        trial[:3, 3] += step[:3]
        return evaluated(trial)

    best, _ = minimizer(lambda _, at: at.model, stepped)(None, evaluated(first), Damping(), _STEPS)
    pose = best.pose
    turned = Rotation.from_matrix(pose[:3, :3] @ first[:3, :3].T).magnitude()
    return pose if np.degrees(turned) < _FARTHEST else first
