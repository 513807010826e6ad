"""Prototypes from a user's mesh file, good and bad."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tracking3d.errors import InputError
from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.prototypes import LONGEST_EDGE, MOST_FACES, from_file


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def box_with_texture(folder: Path) -> Path:
    """A GLB whose vertices are doubled along the seams of its texture."""
    box = trimesh.creation.box((2.0, 1.0, 0.5))
    box.unmerge_vertices()
    image = Image.new("RGB", (8, 8), (200, 30, 30))
    uv = np.random.default_rng(0).random((len(box.vertices), 2))
    box.visual = trimesh.visual.TextureVisuals(uv=uv, image=image)
    box.apply_translation([30, 40, 50])
    path = folder / "box.glb"
    box.export(path)
    return path


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb", "off"])
def test_a_mesh_file_becomes_a_centred_unit_mesh(tmp_path, suffix):
    path = tmp_path / f"capsule.{suffix}"
    capsule = trimesh.creation.capsule(height=2.0, radius=0.5)
    capsule.apply_translation([10.0, -3.0, 7.0])
    capsule.export(path)
    mesh = from_file(path)
    np.testing.assert_allclose(mesh.vertices.min(0), -mesh.vertices.max(0), atol=1e-6)
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1.0)
    assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int64
    assert mesh.face_uvs.shape == (*mesh.faces.shape, 2)
    assert np.isfinite(mesh.face_uvs).all()
    assert solid(mesh).is_watertight and solid(mesh).volume > 0


def test_vertices_that_were_doubled_for_a_texture_are_one_again(tmp_path):
    mesh = from_file(box_with_texture(tmp_path))
    assert solid(mesh).is_watertight
    assert solid(mesh).euler_number == 2


def test_a_coarse_mesh_is_refined_without_changing_its_shape(tmp_path):
    mesh = from_file(box_with_texture(tmp_path))
    fine = solid(mesh)
    assert fine.edges_unique_length.max() <= LONGEST_EDGE
    assert fine.volume == pytest.approx(2 * 1 * 0.5 / np.linalg.norm([1, 0.5, 0.25]) ** 3)
    assert len(mesh.faces) <= MOST_FACES
    a, b = mesh.face_uvs[:, 1] - mesh.face_uvs[:, 0], mesh.face_uvs[:, 2] - mesh.face_uvs[:, 0]
    areas = abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    assert (areas > 0).all() and areas.sum() == pytest.approx(1.0, abs=0.15)


def test_a_fine_mesh_keeps_its_faces(tmp_path):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=4).export(path)
    assert len(from_file(path).faces) == 5120


def test_a_mesh_turned_inside_out_is_turned_back(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.invert()
    ball.export(tmp_path / "ball.ply")
    assert solid(from_file(tmp_path / "ball.ply")).volume > 0


def test_a_scene_of_several_parts_is_taken_as_a_whole(tmp_path):
    parts = [trimesh.creation.icosphere(subdivisions=3) for _ in range(2)]
    parts[1].apply_translation([3.0, 0.0, 0.0])
    trimesh.Scene(parts).export(tmp_path / "two.glb")
    mesh = from_file(tmp_path / "two.glb")
    assert len(mesh.faces) == 2 * 1280
    assert mesh.vertices[:, 0].min() == pytest.approx(-1.0, abs=0.01)


def test_an_open_mesh_and_degenerate_triangles_are_no_obstacle(tmp_path):
    path = tmp_path / "sheet.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 2 0 0\nf 1 2 3\nf 2 4 3\nf 1 2 5\nf 1 1 2\n")
    mesh = from_file(path)
    assert solid(mesh).area > 0
    assert np.isfinite(mesh.face_uvs).all()


@pytest.mark.parametrize("clip", ["003_cracker_box", "006_mustard_bottle", "035_power_drill"])
def test_scanned_household_objects_can_be_prototypes(shared_data, clip):
    mesh = from_file(shared_data / "meshes" / clip / "textured.obj")
    assert len(mesh.faces) > 1000
    assert np.isfinite(mesh.face_uvs).all()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("missing.obj", None, "does not exist"),
        ("empty.obj", b"", "no triangles|cannot be read"),
        ("words.obj", b"this is not a mesh\n", "no triangles|cannot be read"),
        ("noise.glb", bytes(range(256)) * 8, "cannot be read"),
        ("noise.ply", bytes(range(256)) * 8, "cannot be read"),
        ("noise.stl", bytes(range(256)) * 8, "no triangles|cannot be read"),
        ("picture.png", b"\x89PNG\r\n\x1a\n", "cannot be read"),
        ("no_suffix", b"v 0 0 0\n", "cannot be read"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("line.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "without area"),
        ("point.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "at one point"),
        ("nan.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("not_text.obj", b"v 0 0 0\nv 1 0 0\xff\xfe\n", r"cannot be read as a mesh \("),
        ("beyond.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "no triangles|cannot be read"),
    ],
)
def test_what_is_no_mesh_is_refused_in_one_sentence(tmp_path, name, content, said):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=said) as refusal:
        from_file(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).startswith("The prototype ") and str(refusal.value).endswith(".")


def test_a_name_that_no_file_can_have_is_one_that_does_not_exist(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        from_file(tmp_path / ("x" * 3000))


def test_a_truncated_file_is_refused(tmp_path):
    path = tmp_path / "ball.glb"
    trimesh.creation.icosphere(subdivisions=3).export(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InputError, match="cannot be read"):
        from_file(path)


def test_a_folder_is_no_mesh_file(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        from_file(tmp_path)
