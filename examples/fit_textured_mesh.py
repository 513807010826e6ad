"""Fit a textured mesh to images whose cameras and poses are known: shape and colour from a sphere, in plain torch.

python examples/fit_textured_mesh.py [STEPS]
"""

import sys

import torch
from kornia.losses import CauchyLoss

from tracking3d.geometry.prototypes import sphere
from tracking3d.modules import (
    LaplacianLoss,
    MeshRenderer,
    SilhouetteLoss,
    TexturedMesh,
    pinhole_of_camera,
    se3_from_matrix,
)
from tracking3d.rendering import SoftBand
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize


def fit(
    images: torch.Tensor, masks: torch.Tensor, camera, pose, steps: int
) -> tuple[TexturedMesh, list[float]]:
    """Fit to ``images`` (B, 3, H, W) and ``masks`` (B, 1, H, W); gives the mesh and the loss of every step."""
    mesh = TexturedMesh.of(sphere(frequency=8), torch.full((3, 96, 96), 0.5))
    renderer = MeshRenderer(SoftBand(sigma=2000.0, boxlen=0.05))
    overlap, colour, smooth = SilhouetteLoss(), CauchyLoss(), LaplacianLoss(mesh.faces, len(mesh.vertices))
    optimizer = torch.optim.Adam(
        [{"params": [mesh.vertices], "lr": 0.01}, {"params": [mesh.texture], "lr": 0.05}]
    )
    losses = []
    for _ in range(steps):
        views = renderer(mesh, camera, pose)
        loss = overlap(views.silhouette, masks) + 20 * smooth(mesh.vertices)
        loss = loss + 5 * colour(4 * views.image * masks, 4 * images * masks).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return mesh, losses


def main(steps: int = 150) -> list[float]:
    """Fit to a synthetic clip that turns by 15 degrees a frame."""
    clip = synthesize(SyntheticSpec(frames=12, degrees_per_frame=15.0, size=(128, 96), drift=(0, 0, 0)))
    images = torch.tensor(clip.images).permute(0, 3, 1, 2).float() / 255
    masks = torch.tensor(clip.masks)[:, None].float()
    _, losses = fit(images, masks, pinhole_of_camera(clip.camera), se3_from_matrix(clip.T_cam_obj), steps)
    print(f"loss {losses[0]:.3f} at first, {losses[-1]:.3f} after {steps} steps")
    return losses


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
