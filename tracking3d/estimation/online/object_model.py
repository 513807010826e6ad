"""The map as the object that is handed out: one textured mesh."""

from __future__ import annotations

from tracking3d.estimation.appearance import visible_texture
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.estimation.online.belief import ObjectMap
from tracking3d.rendering import BackProjection, Surface


def object_model(known: ObjectMap, surface: Surface) -> ObjectModel:
    """The mesh with its visible texture back-projected from the keyframes.

    Args:
        known: The map.
        surface: Its surface, with the texture of features.
    """
    size = known.texels.size
    seen = BackProjection(known.vertices.new_zeros(3, size, size), known.vertices.new_zeros(size, size))
    for view in known.keyframes:
        seen = seen + known.back_project(view.observation.image, view)
    texture, weight = visible_texture(seen)
    return ObjectModel(
        known.vertices.double().cpu().numpy(),
        known.shape.faces.cpu().numpy(),
        known.shape.face_uvs.double().cpu().numpy(),
        texture,
        weight,
        surface.texture.permute(1, 2, 0).cpu().numpy(),
    )
