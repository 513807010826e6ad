"""The differentiable renderer (DIB-R). Knows nothing of video or tracking."""

from tracking3d.rendering.backprojection import BackProjection, TexelMap, back_project
from tracking3d.rendering.renderer import Rendering, SoftBand, project, render
from tracking3d.rendering.silhouette import soft_silhouette
from tracking3d.rendering.texture import sample_texture
from tracking3d.rendering.visibility import Visibility, rasterize

__all__ = [
    "BackProjection",
    "Rendering",
    "SoftBand",
    "TexelMap",
    "Visibility",
    "back_project",
    "project",
    "rasterize",
    "render",
    "sample_texture",
    "soft_silhouette",
]
