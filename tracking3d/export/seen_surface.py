"""Visibility of the object's vertices in frames, and their colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.export.exported_run import ExportedRun, PosedFrame
from tracking3d.rendering import render, sample_texture, visible_vertices


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """V vertices in N frames with a pose."""

    points: NDArray[np.float64]  # (V, 3) object coordinates in the unit of the export
    colours: NDArray[np.uint8]  # (V, 3) uint8 RGB
    pixels: NDArray[np.float64]  # (N, V, 2) where they are; (0, 0) is the centre of the top-left pixel
    # (N, V) whether they are seen: in the frame, unhidden, and within the estimated mask
    seen: NDArray[np.bool_]


def find_seen_surface(run: ExportedRun) -> SeenSurface:
    """Look for every vertex in every frame.

    Raises:
        InputError: If the run has no mesh.
    """
    model = run.model
    looks = [_look(run, one) for one in run.poses]
    return SeenSurface(
        model.vertices,
        vertex_colours(model),
        np.stack([pixels for pixels, _ in looks]),
        np.stack([seen for _, seen in looks]),
    )


def vertex_colours(model: ObjectModel) -> NDArray[np.uint8]:
    """``(V, 3)`` RGB of the texture at each vertex; black for one without a face."""
    vertices, first = np.unique(model.faces.ravel(), return_index=True)
    uv = torch.tensor(model.face_uvs.reshape(-1, 2)[first], dtype=torch.float32)
    texture = torch.tensor(model.texture, dtype=torch.float32).permute(2, 0, 1)
    colours = np.zeros((len(model.vertices), 3), np.uint8)
    colours[vertices] = sample_texture(texture, uv).round().clamp(0, 255).numpy().astype(np.uint8)
    return colours


def _look(run: ExportedRun, one: PosedFrame) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where the vertices are in a frame ``(V, 2)``, and whether they are seen ``(V,)``."""
    model, camera = run.model, one.camera
    drawn = render(
        torch.tensor(model.vertices, dtype=torch.float32),
        torch.tensor(model.faces),
        torch.tensor(model.face_uvs, dtype=torch.float32),
        torch.zeros((1, 1, 1)),
        torch.tensor(one.T_cam_obj[None, :3, :3], dtype=torch.float32),
        torch.tensor(one.T_cam_obj[None, :3, 3], dtype=torch.float32),
        torch.tensor(camera.K[None], dtype=torch.float32),
        size=(camera.height, camera.width),
    )
    pixels = drawn.screen[0].double().numpy()
    seen: NDArray[np.bool_] = visible_vertices(drawn)[0].numpy()
    column, row = np.where(seen[:, None], pixels, 0.0).round().astype(int).T
    return pixels, seen & run.pinhole_mask(one.index)[
        row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)
    ]
