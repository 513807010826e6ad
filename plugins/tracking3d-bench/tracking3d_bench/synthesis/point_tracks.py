"""Points of the object's surface, where they are in every frame, and whether they are seen there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d_bench.synthesis.pixel_rays import camera_to_pixels
from tracking3d_bench.synthesis.scene import Scene

Array = NDArray[np.float64]

_CANDIDATES = 10  # tried for each point that is wanted
_SAME = 1e-3  # depth in object radii within which a ray's hit and a point are one


@dataclass(frozen=True, eq=False)
class GroundTruthTracks:
    """N surface points in T frames."""

    positions: Array  # (T, N, 2) pixels x and y, also where a point is hidden; NaN behind the camera
    visible: NDArray[np.bool_]  # (T, N) bool: in the image, facing the camera, with nothing in front
    object_points: Array  # (N, 3) in object coordinates


def sample_point_tracks(scene: Scene, count: int = 200) -> GroundTruthTracks:
    """Random points, evenly spread over what is seen of the object in at least one frame.

    Fewer than ``count`` only if hardly anything of the object is seen.
    """
    rng = scene.spec.random("points")
    points, faces = _on_surface(scene, _CANDIDATES * count, rng)
    tracks = [_in_frame(scene, n, T, points, faces) for n, T in enumerate(scene.T_cam_obj)]
    positions, visible = (np.stack(part) for part in zip(*tracks, strict=True))
    chosen = np.flatnonzero(visible.any(0))[:count]
    return GroundTruthTracks(positions[:, chosen], visible[:, chosen], points[chosen])


def _on_surface(scene: Scene, count: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Points ``(count, 3)`` uniform by area, and their faces ``(count,)``."""
    triangles = scene.solid.vertices[scene.solid.faces]
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    faces = rng.choice(len(area), count, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), count)
    return np.einsum("nc,ncd->nd", weights, triangles[faces]), faces


def _in_frame(
    scene: Scene, frame: int, T: Array, points: Array, faces: NDArray[np.int64]
) -> tuple[Array, NDArray[np.bool_]]:
    R, t = T[:3, :3], T[:3, 3]
    in_camera = points @ R.T + t
    pixels = camera_to_pixels(scene.camera, in_camera)
    inside = ((pixels >= -0.5) & (pixels < (scene.camera.width - 0.5, scene.camera.height - 0.5))).all(1)
    origin = -R.T @ t
    ahead = np.flatnonzero(inside)  # NaN is not inside
    facing = np.einsum("ij,ij->i", scene.surface.face_normals[faces[ahead]], origin - points[ahead]) > 0
    ahead = ahead[facing]
    rays = points[ahead] - origin
    hits = scene.surface.cast(np.tile(origin, (len(ahead), 1)), rays)
    tolerance = _SAME * scene.solid.radius / np.linalg.norm(rays, axis=1)
    seen = ahead[(hits.face >= 0) & (hits.distance > 1 - tolerance)]
    surface = scene.hand.surface_at(float(frame)) if scene.hand else None
    if scene.hand is not None and surface is not None:
        T_hand = scene.hand.T_cam_hand(float(frame))
        start = np.tile(-T_hand[:3, :3].T @ T_hand[:3, 3], (len(seen), 1))
        over = surface.cast(start, in_camera[seen] @ T_hand[:3, :3])
        seen = seen[over.distance > 1]
    visible = np.zeros(len(points), bool)
    visible[seen] = True
    return pixels, visible
