"""Points of the turned solid and what its views show of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from turned_solid import CAMERA, turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.local_mapping import project_points
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.pose import pose_arrays


def seen_points(object_map: ObjectMap, view: Keyframe, least: float = 0.6) -> NDArray[np.float64]:
    """Vertices ``(N, 3)`` that face a view's camera and are well inside the outline."""
    vertices = object_map.vertices.double().numpy()
    R, t = pose_arrays(view.pose)
    corners = vertices[object_map.shape.faces.numpy()]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, object_map.shape.faces.numpy()[:, corner], across)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    towards = -(vertices @ R.T + t)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return vertices[np.sum((normals @ R.T) * towards, 1) > least]


def pixels_of(points: NDArray[np.float64], view: Keyframe) -> NDArray[np.float32]:
    """``(N, 2)`` where a view shows points."""
    return project_points(points, view.pose, CAMERA).astype(np.float32)


def map_with_points(angles: list[float], beyond: float = 0.6) -> ObjectMap:
    """The turned solid, whose landmarks are vertices that the middle view shows; every view shows all of them."""
    object_map = turned_map(angles)
    points = seen_points(object_map, object_map.keyframes[len(angles) // 2], beyond)
    names = np.arange(len(points))
    keyframes = tuple(
        replace(view, points=FollowedPoints(names, pixels_of(points, view))) for view in object_map.keyframes
    )
    return replace(object_map, landmarks=points, candidate=np.zeros(len(points), bool), keyframes=keyframes)
