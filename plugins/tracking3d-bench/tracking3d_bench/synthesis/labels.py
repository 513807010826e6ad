"""One small printed label on an object that is plain otherwise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.testing.synthesis.procedural_texture import FloatImage, paint_panel
from tracking3d_bench.synthesis.patches import Array, Patch

_WIDTH, _HEIGHT = (0.35, 0.55), (0.22, 0.36)  # of a label, in object coordinates
_SAMPLES = 4000  # points of the surface among which a label's place is chosen
_AROUND = 0.2  # distance within which a surface is as good as flat


def stick_label(
    patches: Sequence[Patch], panels: Sequence[FloatImage], rng: np.random.Generator
) -> list[FloatImage]:
    """The panels with a label in one of them, at half height on a random side.

    Args:
        patches: Pieces of the surface, y up.
        panels: ``(S, S, 3)`` of each.
        rng: Chooses side, size and print.
    """
    angle = rng.uniform(0, 2 * math.pi)
    out = np.array([math.cos(angle), 0.0, math.sin(angle)])
    across = np.array([-out[2], 0.0, out[0]])
    owner, points, normals, uvs = _sample(patches, rng)
    share = np.bincount(owner, minlength=len(patches))
    large = share[owner] > 0.5 * share.max()  # no label on a handle
    fit = large & (normals @ out > 0.3)  # nor on the inside
    owner, points, normals, uvs = owner[fit], points[fit], normals[fit], uvs[fit]
    best = int((points @ out - 1.5 * np.abs(points[:, 1]) - 0.5 * np.abs(points @ across)).argmax())
    near = (owner == owner[best]) & (normals @ normals[best] > 0.5)
    near &= np.linalg.norm(points - points[best], axis=1) < _AROUND
    # Texture coordinates are nearly linear in the place on the surface.
    slope = np.linalg.lstsq(points[near] - points[best], uvs[near] - uvs[best], rcond=1e-2)[0]
    size = np.array([rng.uniform(*_WIDTH), rng.uniform(*_HEIGHT)]) * np.linalg.norm(slope, axis=0)
    label = paint_panel(rng, 256)
    panel = panels[owner[best]]
    side = len(panel)
    width, height = (max(2, min(round(share * side), side)) for share in size.tolist())
    shown = label[: round(256 * min(1.0, height / width)), : round(256 * min(1.0, width / height))]
    shrunk = cv2.resize(shown, (width, height), interpolation=cv2.INTER_AREA)
    left = int(np.clip(round(uvs[best, 0] * side - 0.5 * width), 0, side - width))
    top = int(np.clip(round((1 - uvs[best, 1]) * side - 0.5 * height), 0, side - height))
    labelled = panel.copy()
    labelled[top : top + height, left : left + width] = shrunk
    return [labelled if k == owner[best] else one for k, one in enumerate(panels)]


def _sample(
    patches: Sequence[Patch], rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Points all over the surface.

    Returns:
        Which patch each point is on ``(N,)``, its place and normal ``(N, 3)``, and its texture coordinates ``(N, 2)``.
    """
    owner = np.concatenate([np.full(len(patch.faces), k) for k, patch in enumerate(patches)])
    corners = np.concatenate([patch.vertices[patch.faces] for patch in patches])
    uvs = np.concatenate([patch.uvs[patch.faces] for patch in patches])
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    faces = rng.choice(len(area), _SAMPLES, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), _SAMPLES)[:, :, None]
    places = (weights * corners[faces]).sum(1)
    return owner[faces], places, across[faces] / area[faces, None], (weights * uvs[faces]).sum(1)
