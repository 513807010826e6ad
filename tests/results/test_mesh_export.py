"""Exported meshes say what the model says, in the conventions of their formats."""

from __future__ import annotations

import dataclasses
import io
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.gltf_axes import read_mesh_file
from tracking3d.geometry.prototypes import from_file
from tracking3d.results.contact_sheet import most_different, render_view, side_shown
from tracking3d.results.mesh_export import export_mesh, load_mesh, load_model, sort_seen_first
from tracking3d_bench.datasets.truth import MeshFile
from tracking3d_bench.synthesis.mesh_files import load_solid
from tracking3d_bench.synthesis.spec import SequenceSpec


def parse_glb(data: bytes) -> tuple[dict, bytes]:
    """JSON and binary chunk, read by the specification's byte layout."""
    magic, version, length, json_length, json_kind = struct.unpack("<4sII I4s", data[:20])
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + json_length]), data[28 + json_length :]


def accessor(tree: dict, binary: bytes, number: int) -> np.ndarray:
    entry = tree["accessors"][number]
    view = tree["bufferViews"][entry["bufferView"]]
    start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
    kind = {5126: np.float32, 5125: np.uint32, 5123: np.uint16}[entry["componentType"]]
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[entry["type"]]
    return np.frombuffer(binary, kind, entry["count"] * columns, start).reshape(-1, columns)


def seen_all_round(model: ObjectModel) -> ObjectModel:
    """A model whose GLB has one primitive, in the order of its faces."""
    return dataclasses.replace(model, texture_weight=np.ones_like(model.texture_weight))


def test_the_glb_holds_positions_texture_coordinates_and_image_as_gltf_defines_them(tmp_path, turning_sphere):
    model = seen_all_round(turning_sphere.model)
    export_mesh(tmp_path, model)
    tree, binary = parse_glb((tmp_path / "mesh.glb").read_bytes())
    (primitive,) = [p for mesh in tree["meshes"] for p in mesh["primitives"]]
    position = accessor(tree, binary, primitive["attributes"]["POSITION"])
    uv = accessor(tree, binary, primitive["attributes"]["TEXCOORD_0"])
    normal = accessor(tree, binary, primitive["attributes"]["NORMAL"])
    index = accessor(tree, binary, primitive["indices"]).reshape(-1, 3)
    assert np.allclose(position[index], model.vertices[model.faces], atol=1e-6)
    # glTF's v runs down the image, as the model's does; the seam goes past 1 and the sampler repeats.
    assert np.allclose(uv[index], model.face_uvs, atol=1e-6)
    assert uv[:, 0].max() > 1
    assert [(s["wrapS"], s["wrapT"]) for s in tree["samplers"]] == [(10497, 33071)]
    assert all(texture["sampler"] == 0 for texture in tree["textures"])
    assert np.allclose(normal, position / np.linalg.norm(position, axis=1, keepdims=True), atol=0.05)
    view = tree["bufferViews"][tree["images"][0]["bufferView"]]
    start = view.get("byteOffset", 0)
    image = Image.open(io.BytesIO(binary[start : start + view["byteLength"]]))
    assert np.array_equal(np.asarray(image.convert("RGB")), model.texture)
    names = [part["name"] for kind in ("nodes", "meshes", "materials") for part in tree[kind]]
    assert names == ["tracking3d_y_up", "tracking3d_object", "tracking3d_object", "texture"]
    # The mesh is in object coordinates; half a turn about x, above it, makes y up and z towards the viewer.
    root, child = tree["nodes"]
    assert (root["rotation"], root["children"], child["mesh"]) == ([1, 0, 0, 0], [1], 0)
    assert tree["scenes"][tree["scene"]]["nodes"] == [0]


def test_the_obj_refers_to_its_material_and_texture_with_v_upwards(tmp_path, turning_sphere):
    model = turning_sphere.model
    export_mesh(tmp_path, model)
    rows: dict[str, list[list[str]]] = {}
    for line in (tmp_path / "mesh.obj").read_text().splitlines():
        key, *values = line.split() or ["#"]
        rows.setdefault(key, []).append(values)
    assert rows["mtllib"] == [["mesh.mtl"]]
    material = (tmp_path / "mesh.mtl").read_text()
    assert f"newmtl {rows['usemtl'][0][0]}" in material
    assert "map_Kd texture.png" in material
    assert "Kd 1.00000000 1.00000000 1.00000000" in material  # the texture is not darkened
    corners = np.array([[corner.split("/")[:2] for corner in face] for face in rows["f"]]).astype(int) - 1
    vertices, uvs = np.array(rows["v"], dtype=float), np.array(rows["vt"], dtype=float)
    assert np.allclose(vertices[corners[..., 0]], model.vertices[model.faces], atol=1e-8)
    assert np.allclose(uvs[corners[..., 1]] * [1, -1] + [0, 1], model.face_uvs, atol=1e-8)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "texture.png")), model.texture)


def test_vertices_are_doubled_at_the_seam_only(tmp_path, turning_sphere):
    model = turning_sphere.model
    export_mesh(tmp_path, model)
    mesh = load_mesh(tmp_path)
    distinct = {
        (vertex, *uv)
        for vertex, uv in zip(model.faces.ravel(), model.face_uvs.reshape(-1, 2).tolist(), strict=True)
    }
    assert len(mesh.vertices) == len(distinct)
    assert len(model.vertices) < len(mesh.vertices) < 1.2 * len(model.vertices)


def test_the_glb_has_one_vertex_for_each_distinct_position_and_texture_coordinate(tmp_path, turning_sphere):
    model = seen_all_round(turning_sphere.model)
    # Texture coordinates that differ by rounding are no seam.
    jitter = 1e-12 * np.random.default_rng(0).standard_normal(model.face_uvs.shape)
    export_mesh(tmp_path, dataclasses.replace(model, face_uvs=model.face_uvs + jitter))
    tree, binary = parse_glb((tmp_path / "mesh.glb").read_bytes())
    (primitive,) = tree["meshes"][0]["primitives"]
    position, uv = (
        accessor(tree, binary, primitive["attributes"][key]) for key in ("POSITION", "TEXCOORD_0")
    )
    corners = np.concatenate([model.vertices[model.faces], model.face_uvs], axis=2).reshape(-1, 5)
    distinct = np.unique(corners.round(6), axis=0)
    assert len(position) == len(distinct) < len(model.faces)
    assert len(np.unique(np.concatenate([position, uv], axis=1), axis=0)) == len(position)
    assert len(np.unique(position, axis=0)) == len(model.vertices)


def test_through_its_scene_graph_the_glb_is_the_obj_turned_half_about_x_with_the_texture(
    tmp_path, turning_sphere
):
    export_mesh(tmp_path, seen_all_round(turning_sphere.model))
    obj, glb = load_mesh(tmp_path), trimesh.load_mesh(tmp_path / "mesh.glb", process=False)
    assert np.allclose(glb.vertices[glb.faces], obj.vertices[obj.faces] * [1, -1, -1], atol=1e-6)
    assert np.allclose(glb.vertex_normals[glb.faces], obj.vertex_normals[obj.faces] * [1, -1, -1], atol=1e-5)
    assert np.allclose(glb.visual.uv[glb.faces], obj.visual.uv[obj.faces], atol=1e-6)
    texture = np.asarray(glb.visual.material.baseColorTexture.convert("RGB"))
    assert np.array_equal(texture, turning_sphere.model.texture)


def test_a_gltf_camera_in_front_sees_what_the_first_frame_saw(tmp_path, turning_sphere):
    export_mesh(tmp_path, seen_all_round(turning_sphere.model))
    mesh = trimesh.load_mesh(tmp_path / "mesh.glb", process=False)
    # glTF's camera looks along -z with y up; it stands before the object, at positive z, and its image rows
    # run down. The first frame's camera: the object's axes, at negative z.
    camera = mesh.vertices - np.array([0, 0, 4.0])
    seen = np.stack([camera[:, 0], -camera[:, 1]], axis=1) / -camera[:, 2:]
    obj = load_mesh(tmp_path)
    first = obj.vertices + np.array([0, 0, 4.0])
    assert np.allclose(seen[mesh.faces], (first[:, :2] / first[:, 2:])[obj.faces], atol=1e-6)


def test_every_reader_of_meshes_takes_the_glb_for_what_the_obj_is(tmp_path, turning_sphere):
    export_mesh(tmp_path, sort_seen_first(turning_sphere.model)[0])
    obj, glb = tmp_path / "mesh.obj", tmp_path / "mesh.glb"

    def triangles(read):
        return [mesh.vertices[mesh.faces] for mesh in map(read, (obj, glb))]

    spec = SequenceSpec()
    for read in (from_file, lambda path: MeshFile(path).read(), lambda path: load_solid(path, spec)):
        from_obj, from_glb = triangles(read)
        assert np.allclose(from_obj, from_glb, atol=1e-6)


def test_a_glb_of_others_is_read_with_the_axes_that_it_has(tmp_path):
    part = trimesh.creation.box((1, 2, 3))
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])
    scene = trimesh.Scene()
    scene.add_geometry(part, transform=turn)
    scene.export(tmp_path / "box.glb")
    assert np.allclose(MeshFile(tmp_path / "box.glb").read().extents, [2, 1, 3])


def test_a_mesh_makes_the_round_trip(tmp_path, turning_sphere):
    model, seen = sort_seen_first(turning_sphere.model)
    assert 0 < seen < len(model.faces)
    export_mesh(tmp_path, model)
    for mesh in (load_mesh(tmp_path), read_mesh_file(tmp_path / "mesh.glb")):
        assert np.allclose(mesh.vertices[mesh.faces], model.vertices[model.faces], atol=1e-6)
        uv = mesh.visual.uv[mesh.faces] * [1, -1] + [0, 1]
        assert np.allclose(uv, model.face_uvs, atol=1e-6)
    texture = load_mesh(tmp_path).visual.material.image
    assert np.array_equal(np.asarray(texture.convert("RGB")), model.texture)


def test_the_exact_model_makes_the_round_trip(tmp_path, turning_sphere):
    export_mesh(tmp_path, turning_sphere.model)
    assert load_model(tmp_path).seen is None
    whole = dataclasses.replace(turning_sphere.model, seen=turning_sphere.model.vertices[:, 2] < 0)
    export_mesh(tmp_path, whole)
    model = load_model(tmp_path)
    for field in dataclasses.fields(model):
        written, read = getattr(whole, field.name), getattr(model, field.name)
        assert np.array_equal(written, read), field.name
        assert written.dtype == read.dtype, field.name


@pytest.mark.parametrize(("load", "name"), [(load_mesh, "mesh.obj"), (load_model, "features.npz")])
def test_an_absent_or_damaged_mesh_is_said_in_one_sentence(tmp_path, turning_sphere, load, name):
    with pytest.raises(InputError, match=f"holds no {name}"):
        load(tmp_path)
    export_mesh(tmp_path, turning_sphere.model)
    (tmp_path / name).write_bytes(b"v 1 nonsense\nf 1 2 3\n")
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path)


def test_a_view_of_the_mesh_shows_the_texture_where_it_was_seen(turning_sphere):
    model = dataclasses.replace(
        turning_sphere.model,
        texture=np.full((64, 64, 3), (200, 40, 90), dtype=np.uint8),
        texture_weight=np.concatenate([np.ones((32, 64)), np.zeros((32, 64))]).astype(np.float32),
    )
    picture = render_view(model, np.eye(3), 101).astype(int)
    assert np.array_equal(picture[0, 0], [40, 40, 40])
    upper, lower = picture[40, 50], picture[60, 50]  # the texture's upper half is up in the picture
    assert np.abs(upper - [200, 40, 90]).max() < 10
    assert np.ptp(lower) == 0
    assert np.abs(lower - 165).max() < 8


def pose(turn: float, translation: tuple[float, float, float] = (0.0, 0.0, 4.0)) -> np.ndarray:
    """Object to camera, turned by ``turn`` degrees around a slanted axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(turn) * np.array([0.0, 0.96, 0.28])).as_matrix()
    T[:3, 3] = translation
    return T


def test_the_side_that_a_frame_shows_is_in_the_middle_of_the_picture():
    middle, T = np.array([0.1, -0.2, 0.3]), pose(40, (1.0, -0.5, 3.0))
    rotation = side_shown(T, middle)
    assert np.allclose(rotation @ rotation.T, np.eye(3))
    towards = -(T[:3, :3].T @ T[:3, 3] + middle)  # from the middle to the camera, in object coordinates
    assert np.allclose(rotation @ (towards / np.linalg.norm(towards)), [0, 0, -1])
    T[:3, 3] = 0, 0, 5
    assert np.allclose(side_shown(T, np.zeros(3)), T[:3, :3])


def test_a_pose_behind_the_camera_or_without_numbers_shows_no_side():
    assert side_shown(pose(10, (0, 0, -3)), np.zeros(3)) is None
    assert side_shown(np.full((4, 4), np.nan), np.zeros(3)) is None


def test_the_views_that_differ_most_are_chosen_and_none_twice():
    rotations = np.stack([pose(turn)[:3, :3] for turn in (0, 5, 10, 170, 175, 90)])
    assert most_different(rotations, 3) == [0, 4, 5]
    assert sorted(most_different(rotations, 9)) == list(range(6))
    assert sorted(most_different(np.repeat(np.eye(3)[None], 4, 0), 3))[:2] == [0, 1]
