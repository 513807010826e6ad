"""What is made of a tracked object once its poses are known: a texture at the resolution of the video."""

from tracking3d.reconstruction.texturing import bake_texture
from tracking3d.reconstruction.views import BELIEVED, TextureView, kept_views, texture_view

__all__ = ["BELIEVED", "TextureView", "bake_texture", "kept_views", "texture_view"]
