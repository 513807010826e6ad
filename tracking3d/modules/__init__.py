"""The renderer, its silhouette and its losses as ``nn.Module``, and our cameras and poses as kornia's."""

from tracking3d.modules.losses import LaplacianLoss, OutlineLoss, SilhouetteLoss, TextureLoss
from tracking3d.modules.renderer import (
    MeshRenderer,
    RenderedViews,
    Silhouette,
    TexturedMesh,
    camera_from_pinhole,
    pinhole_of_camera,
    pose_from_se3,
    quaternion_from_kornia,
    quaternion_of_pose,
    se3_from_matrix,
    se3_of_pose,
)

__all__ = [
    "LaplacianLoss",
    "MeshRenderer",
    "OutlineLoss",
    "RenderedViews",
    "Silhouette",
    "SilhouetteLoss",
    "TextureLoss",
    "TexturedMesh",
    "camera_from_pinhole",
    "pinhole_of_camera",
    "pose_from_se3",
    "quaternion_from_kornia",
    "quaternion_of_pose",
    "se3_from_matrix",
    "se3_of_pose",
]
