"""What is made of a tracked object once its poses are known: a texture at the resolution of the video."""

from tracking3d.reconstruction.seen_regions import close_unseen
from tracking3d.reconstruction.texturing import bake_texture
from tracking3d.reconstruction.views import keep_best_views, texture_view

__all__ = ["bake_texture", "close_unseen", "keep_best_views", "texture_view"]
