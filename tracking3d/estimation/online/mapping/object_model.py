"""The map as the resulting object: one textured mesh."""

from __future__ import annotations

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.shape import visible_texture
from tracking3d.rendering import BackProjection, Surface


def object_model(object_map: ObjectMap, surface: Surface) -> ObjectModel:
    """The mesh with its visible texture back-projected from the keyframes.

    Args:
        object_map: The map.
        surface: Its surface, with the texture of features.
    """
    size = object_map.texels.size
    seen = BackProjection(
        object_map.vertices.new_zeros(3, size, size), object_map.vertices.new_zeros(size, size)
    )
    for view in object_map.keyframes:
        seen = seen + object_map.back_project(view.observation.image, view)
    texture, weight = visible_texture(seen)
    return ObjectModel(
        object_map.vertices.double().cpu().numpy(),
        object_map.shape.faces.cpu().numpy(),
        object_map.shape.face_uvs.double().cpu().numpy(),
        texture,
        weight,
        surface.texture.permute(1, 2, 0).cpu().numpy(),
    )
