"""A data set of nerfstudio's: ``transforms.json``, pictures, masks, and a point cloud to start from.

The camera moves about the still object. ``transform_matrix`` maps camera to world with OpenGL's camera axes: x right, y
up, z backward; the world is the object, with the object's own axes. Pixel (0.5, 0.5) is the centre of the top-left one.
Frames without a pose are left out. https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

import json
from pathlib import Path

import trimesh

from tracking3d.export.axes import HALF_TURN, inverse
from tracking3d.export.colmap import CENTRE
from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.seen_surface import find_seen_surface
from tracking3d.export.training_images import picture_name, write_pictures

POINTS = "sparse_pc.ply"


def write_nerfstudio(run: ExportedRun, folder: Path) -> None:
    """Write the data set; pictures and masks unless they were not wanted."""
    folder.mkdir()
    frames = []
    for one in run.poses:
        name = picture_name(run, one.index)
        frame = {"file_path": f"images/{name}", "mask_path": f"masks/{Path(name).stem}.png"}
        camera = one.camera
        lens = {
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx + CENTRE,
            "cy": camera.cy + CENTRE,
            "w": camera.width,
            "h": camera.height,
        }
        T_world_camera = inverse(one.T_cam_obj) @ HALF_TURN
        frames.append(frame | lens | {"transform_matrix": T_world_camera.tolist()})
    document = {"camera_model": "PINHOLE", "ply_file_path": POINTS, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document, indent=1) + "\n", encoding="ascii")
    surface = find_seen_surface(run)
    seen = surface.seen.any(0)
    cloud = trimesh.PointCloud(surface.points[seen], colors=surface.colours[seen])
    cloud.export(folder / POINTS)
    if run.options.images:
        write_pictures(run, folder / "images", folder / "masks", "{stem}.png")
