"""COLMAP models and nerfstudio data sets: what other programs read of them gives the masks of the run."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tracking3d.results.run_reader import RunReader

READ_MODEL = """
import json, sys
import numpy as np
import pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
images = {}
errors = []
for image in model.images.values():
    camera = model.cameras[image.camera_id]
    pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
    images[image.name] = {"K": camera.calibration_matrix().tolist(), "T": pose.tolist()}
    for seen in image.points2D:
        if seen.has_point3D():
            errors.append(np.abs(image.project_point(model.points3D[seen.point3D_id].xyz) - seen.xy).max())
points = [[*point.xyz.tolist(), *point.color.tolist(), point.track.length()] for point in model.points3D.values()]
json.dump({"images": images, "points": points, "error": max(errors), "seen": len(errors)}, sys.stdout)
"""
NAMES = ["000000", "000001", "000003", "000005", "000006"]
HALF_A_PIXEL = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
"""From pixels counted from the corner of the first one to pixels counted from its centre."""


def read_model(folder: Path) -> dict:
    """What COLMAP reads, in a process of its own: its libraries and torch's do not get on in every installation."""
    if find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    command = [sys.executable, "-c", READ_MODEL, str(folder / "sparse" / "0")]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.parametrize("to", ["colmap", "colmap-binary"])
def test_colmap_itself_reads_the_model(export, shifted_run, silhouettes, to):
    folder = export(shifted_run, to)
    model = read_model(folder)
    mesh = RunReader(shifted_run).mesh()
    assert sorted(model["images"]) == [f"{name}.jpg" for name in NAMES]
    for name, image in model["images"].items():
        K, T = HALF_A_PIXEL @ np.array(image["K"]), np.array(image["T"])
        silhouettes(shifted_run).agree(int(name[:6]), K, T, mesh.vertices, mesh.faces)
        assert (folder / "images" / name).is_file()
        assert (folder / "masks" / f"{name}.png").is_file()
    assert model["error"] < 0.01
    points = np.array(model["points"])
    assert len(points) > 50
    assert points[:, 6].min() >= 2
    np.testing.assert_allclose(cKDTree(mesh.vertices).query(points[:, :3])[0], 0, atol=1e-5)
    assert len(np.unique(points[:, 3:6], axis=0)) > 10


def test_colmap_has_a_camera_for_every_lens(export, zooming_run, silhouettes):
    images = read_model(export(zooming_run, "colmap-binary", images=False))["images"]
    assert sorted({round(image["K"][0][0]) for image in images.values()}) == [120, 150]
    mesh = RunReader(zooming_run).mesh()
    for name, image in images.items():
        K = HALF_A_PIXEL @ np.array(image["K"])
        silhouettes(zooming_run).agree(int(name[:6]), K, np.array(image["T"]), mesh.vertices, mesh.faces)


def test_points_are_those_that_are_seen(export, run):
    """A vertex of the far side is in no image."""
    from tracking3d.export.exported_run import ExportedRun
    from tracking3d.export.options import ExportOptions
    from tracking3d.export.seen_surface import find_seen_surface

    exported = ExportedRun(RunReader(run), ExportOptions())
    surface = find_seen_surface(exported)
    normals = trimesh.Trimesh(exported.model.vertices, exported.model.faces, process=False).vertex_normals
    for row, one in enumerate(exported.poses):
        T_obj_cam = np.linalg.inv(one.T_cam_obj)
        towards = T_obj_cam[:3, 3] - surface.points
        facing = (normals * towards).sum(1) / np.linalg.norm(towards, axis=1)
        assert surface.seen[row][facing > 0.3].mean() > 0.95  # but for those at the edge of the mask
        assert surface.seen[row][facing < -0.3].mean() < 0.02  # where the mesh is sharp, normals are means


def test_nerfstudio_has_opengl_cameras_and_masks(export, shifted_run, silhouettes):
    folder = export(shifted_run, "nerfstudio")
    document = json.loads((folder / "transforms.json").read_text())
    mesh = RunReader(shifted_run).mesh()
    assert [frame["file_path"] for frame in document["frames"]] == [f"images/{name}.jpg" for name in NAMES]
    for frame in document["frames"]:
        T_world_camera = np.array(frame["transform_matrix"])
        T_cam_world = np.diag([1, -1, -1, 1]) @ np.linalg.inv(T_world_camera)
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        index = int(frame["file_path"][-10:-4])
        silhouettes(shifted_run).agree(index, HALF_A_PIXEL @ K, T_cam_world, mesh.vertices, mesh.faces)
        mask = np.asarray(Image.open(folder / frame["mask_path"]))
        np.testing.assert_array_equal(mask == 255, RunReader(shifted_run).mask(index))
        with Image.open(folder / frame["file_path"]) as picture:
            assert picture.size == (frame["w"], frame["h"])
    cloud = trimesh.load(folder / document["ply_file_path"])
    assert len(cloud.vertices) > 50
    assert cloud.colors.shape == (len(cloud.vertices), 4)


def test_rotations_are_rotations(export, run):
    lines = (export(run, "colmap", images=False) / "sparse/0/images.txt").read_text().splitlines()[1::2]
    for line in lines:
        w, x, y, z = map(float, line.split()[1:5])
        assert np.linalg.norm([w, x, y, z]) == pytest.approx(1)
        assert Rotation.from_quat([x, y, z, w]).magnitude() < np.pi


def test_pictures_can_be_cut_out_or_left_out(export, run):
    cut = export(run, "nerfstudio", "cut", cut_out=True)
    picture = Image.open(cut / "images" / "000003.png")
    assert picture.mode == "RGBA"
    np.testing.assert_array_equal(np.asarray(picture)[..., 3] == 255, RunReader(run).mask(3))
    bare = export(run, "colmap", "bare", images=False)
    assert sorted(path.name for path in bare.iterdir()) == ["export.json", "sparse"]
