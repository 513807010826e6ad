"""What is made of a tracked object once its poses are known: a texture at the resolution of the video."""

from tracking3d.reconstruction.texturing import make_texture
from tracking3d.reconstruction.views import BELIEVED, TextureView, keep_best_views, texture_view

__all__ = ["BELIEVED", "TextureView", "keep_best_views", "make_texture", "texture_view"]
