"""The differentiable renderer (DIB-R). Knows nothing of video or tracking."""

from tracking3d.rendering.backend import BackendName, prepare_backend
from tracking3d.rendering.backprojection import (
    BackProjection,
    SeenTexels,
    TexelMap,
    back_project,
    seen_texels,
)
from tracking3d.rendering.contour import (
    Contour,
    contour_loss,
    contour_normal_equations,
    find_contour,
    signed_distance,
)
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.normal_equations import NormalEquations, pose_normal_equations
from tracking3d.rendering.pose_comparison import MatchedPoints, PoseTarget, PoseTerms, Scales
from tracking3d.rendering.pose_terms import pose_terms
from tracking3d.rendering.renderer import Rendering, SoftBand, project, render
from tracking3d.rendering.silhouette import soft_silhouette
from tracking3d.rendering.surface import Surface, sample_texture
from tracking3d.rendering.surface_visibility import visible_texels, visible_vertices
from tracking3d.rendering.texture_losses import channels_last, texture_losses
from tracking3d.rendering.visibility import Visibility, rasterize

__all__ = [
    "BackProjection",
    "BackendName",
    "Contour",
    "MatchedPoints",
    "NormalEquations",
    "PoseTarget",
    "PoseTerms",
    "Rendering",
    "Scales",
    "SeenTexels",
    "SoftBand",
    "Surface",
    "TexelMap",
    "Visibility",
    "back_project",
    "channels_last",
    "contour_loss",
    "contour_normal_equations",
    "find_contour",
    "interpolate",
    "pose_normal_equations",
    "pose_terms",
    "prepare_backend",
    "project",
    "rasterize",
    "render",
    "sample_texture",
    "seen_texels",
    "signed_distance",
    "soft_silhouette",
    "texture_losses",
    "visible_texels",
    "visible_vertices",
]
