"""Names and suffixes by which users look for a format, and the formats that come closest."""

from __future__ import annotations

from collections.abc import Iterable

from tracking3d.config.explain import nearest

OTHER_NAMES = {
    "gltf": ("glb", "animated-glb"),
    **dict.fromkeys(("usd", "usda", "usdc"), ("usdz",)),
    **dict.fromkeys(("ros", "ros2", "rosbag", "bag", "db3"), ("ros-bag",)),
    "obj": ("glb", "nuke"),
    "fbx": ("animated-glb", "usdz"),
    "abc": ("animated-glb", "usdz"),
    "alembic": ("animated-glb", "usdz"),
    "ae": ("after-effects",),
    "jsx": ("after-effects",),
    "chan": ("nuke",),
    "blend": ("blender",),
    "rrd": ("rerun",),
    "mov": ("prores",),
    "webm": ("vp9",),
    "mp4": ("vp9", "prores"),
    "video": ("vp9", "prores"),
    "png": ("davis", "cut-outs"),
    "masks": ("davis", "coco", "vot"),
    "json": ("coco", "nerfstudio"),
    "nerf": ("nerfstudio",),
    "instant-ngp": ("nerfstudio",),
    "gaussian-splatting": ("colmap",),
    "3dgs": ("colmap",),
    "trajectory": ("tum", "kitti"),
    "txt": ("tum",),
    "poses": ("csv", "tum", "bop"),
    "points": ("points-csv", "tapvid"),
    "npz": ("tapvid",),
    "mesh": ("glb", "ply", "stl"),
}
"""By name in small letters, without a dot before it."""


def similar_formats(name: str, formats: Iterable[str]) -> list[str]:
    """The formats that are likely meant by ``name``, which is none of them; none if nothing comes close."""
    known = list(formats)
    if meant := [one for one in OTHER_NAMES.get(name.lower().lstrip("."), ()) if one in known]:
        return meant
    best = nearest(name, known)
    return [] if best is None else [best]
