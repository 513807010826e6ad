"""What `--object` names: runs and meshes of all kinds become a mesh with an atlas, and what is none has a sentence."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from recorded_runs import HEIGHT, WIDTH, estimate_of, frame_of, open_run
from recorded_runs import model as sphere

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.known_object import SIDES, KnownObject, map_of_known_object
from tracking3d.estimation.shape import RADIUS
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.gltf_axes import read_mesh_file
from tracking3d.pipeline.known_object import load_known_object, read_known_object, select_camera
from tracking3d.plugins import FEATURES, build_plugin
from tracking3d.rendering import TexelMap
from tracking3d.rendering.backprojection import face_atlas, on_faces, paint_faces, shares_no_texel


def coloured_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((1, 2, 3))
    box.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (8, 3))
    return box


def in_file(mesh: trimesh.Trimesh, folder, name="thing.ply"):
    mesh.export(folder / name)
    return folder / name


def run_folder(folder, status=Status.TRACKED, camera=None, model=True):
    """A finished run of one frame."""
    with open_run(folder) as writer:
        if camera is not None:
            writer.use_camera(camera)
        writer.write(
            replace(estimate_of(0, status), camera=camera or Camera.from_fov(WIDTH, HEIGHT)), frame_of(0)
        )
        writer.finish(sphere() if model else None, "finished")
    return folder


def glb_of(folder, change) -> Path:
    """A coloured box as GLB, whose glTF tree is changed."""
    data = coloured_box().export(file_type="glb")
    length = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + length :]
    (folder / "thing.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(rest)) + rest)
    return folder / "thing.glb"


def test_a_flat_thing_is_known_by_the_sides_that_show_it(tmp_path):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    known, config = read_known_object(tmp_path / "flat.obj"), load_config()
    learnt, _ = map_of_known_object(
        known, config, build_plugin(FEATURES, config.features), torch.device("cpu")
    )
    assert learnt.fixed_keyframes == len(learnt.keyframes) == SIDES / 2  # it is seen from in front only


def test_positions_of_two_numbers_are_refused(tmp_path):
    def flatten(tree):
        place = tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
        tree["accessors"][place]["type"] = "VEC2"

    with pytest.raises(InputError, match="has positions that are not three numbers each"):
        read_known_object(glb_of(tmp_path, flatten))


@pytest.mark.parametrize("colour", ["", " 1 2 3"])
def test_a_face_of_a_vertex_far_beyond_the_last_is_refused(tmp_path, colour):
    names = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) if colour else ""
    axes = "".join(f"property float {name}\n" for name in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{axes}{names}element face 1\n"
    points = "".join(f"{point}{colour}\n" for point in ("0 0 0", "1 0 0", "0 1 1"))
    text = f"{head}property list uchar int vertex_indices\nend_header\n{points}3 0 1 2000000000\n"
    (tmp_path / "thing.ply").write_text(text)
    with pytest.raises(InputError, match="give the folder of an earlier run, or a mesh file"):
        read_known_object(tmp_path / "thing.ply")


def test_instances_of_a_part_are_read_without_a_copy_each(tmp_path, monkeypatch):
    turn = [0, 0.6, 0, 0.8]

    def place(tree):
        tree["nodes"] = [
            {"mesh": 0, "translation": [n, 0, 0], "rotation": turn, "scale": [(-1) ** n, 1, 2]}
            for n in range(40)
        ]
        tree["scenes"], tree["scene"] = [{"nodes": list(range(40))}], 0

    path = glb_of(tmp_path, place)
    expected = trimesh.load_scene(path, process=False).to_mesh()
    copies, copy = [], trimesh.Trimesh.copy
    monkeypatch.setattr(trimesh.Trimesh, "copy", lambda mesh, **how: copies.append(mesh) or copy(mesh, **how))
    mesh = read_mesh_file(path)
    assert len(copies) < 5
    assert mesh.area == pytest.approx(expected.area) and mesh.volume == pytest.approx(expected.volume)
    order, other = (np.lexsort(one.vertices.round(6).T) for one in (mesh, expected))
    np.testing.assert_allclose(mesh.vertices[order], expected.vertices[other], atol=1e-6)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[order], expected.visual.vertex_colors[other])


def test_the_solver_s_unit_is_left_again_as_it_was_entered():
    model = read_model(trimesh.creation.box((10, 20, 30)).apply_translation((100, 0, -5)))
    known = KnownObject("a box", model)
    assert np.linalg.norm(known.vertices, axis=1).max() == pytest.approx(RADIUS)
    T = np.eye(4)
    T[:3, :3] = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))[:3, :3]
    T[:3, 3] = 3, -2, 200
    inner = known.to_solver(T)
    np.testing.assert_allclose(known.from_solver(inner), T, atol=1e-9)
    x_cam = model.vertices @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(
        known.vertices @ inner[:3, :3].T + inner[:3, 3], known.scale * x_cam, atol=1e-9
    )


def read_model(mesh: trimesh.Trimesh):
    from tracking3d.pipeline.known_object import _model_of

    return _model_of(mesh)


@pytest.mark.parametrize("count", [1, 2, 7, 50])
def test_in_an_atlas_of_faces_each_has_texels_of_its_own(count):
    uvs = face_atlas(count)
    assert shares_no_texel(uvs)
    texels = TexelMap.of(torch.from_numpy(uvs).float(), 256)
    assert set(texels.face.tolist()) == set(range(count))
    names = np.arange(3 * count).reshape(count, 3, 1).astype(float)
    inside = on_faces(names, texels)[:, 0]
    assert (np.floor(inside / 3 + 1e-4).astype(int) == texels.face.numpy()).mean() > 0.99


def test_faces_that_lie_on_one_another_in_an_atlas_share_texels():
    uvs = face_atlas(2)
    assert not shares_no_texel(np.concatenate([uvs, uvs]))
    assert not shares_no_texel(uvs + 0.5)


def test_beside_the_faces_a_texture_goes_on_as_at_their_rim():
    texels = TexelMap.of(torch.from_numpy(face_atlas(1)).float(), 32)
    picture = paint_faces(np.full((len(texels.texel), 3), 77.0), texels)
    assert (picture == 77).all()


def test_colours_of_vertices_are_baked_where_the_vertices_are(tmp_path):
    mesh = coloured_box()
    known = read_known_object(in_file(mesh, tmp_path))
    model = known.model
    assert known.has_colours and shares_no_texel(model.face_uvs)
    side = len(model.texture)
    corner = model.face_uvs.reshape(-1, 2) * 0.8 + model.face_uvs.mean(1).repeat(3, 0) * 0.2
    seen = model.texture[(corner[:, 1] * side).astype(int), (corner[:, 0] * side).astype(int)].astype(float)
    wanted = known_colours(mesh, model)
    assert np.abs(seen - wanted).mean() < 40  # a fifth of the way to the face's middle


def known_colours(mesh, model):
    places = model.vertices[model.faces].reshape(-1, 3)
    nearest = np.linalg.norm(places[:, None] - mesh.vertices[None], axis=2).argmin(1)
    return mesh.visual.vertex_colors[nearest, :3].astype(float)


def test_a_mesh_of_one_colour_has_none_to_be_known_by(tmp_path):
    assert not read_known_object(in_file(trimesh.creation.box(), tmp_path)).has_colours


def test_vertices_that_are_split_are_joined_and_faces_look_outward(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    corners = box.vertices[box.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    faces[3] = faces[3, ::-1]
    model = read_known_object(in_file(trimesh.Trimesh(corners, faces, process=False), tmp_path)).model
    solid = trimesh.Trimesh(model.vertices, model.faces, process=False)
    assert len(model.vertices) == 8 and solid.is_watertight and solid.volume == pytest.approx(6)


def test_a_face_that_is_turned_round_keeps_its_texture():
    solid = trimesh.creation.icosphere(1)
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    uv = np.concatenate([face_atlas(len(solid.faces)).reshape(-1, 2)])
    uv[:, 1] = 1 - uv[:, 1]
    corners = solid.vertices[solid.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    turned = faces.copy()
    turned[::2] = turned[::2, ::-1]
    material = trimesh.visual.material.SimpleMaterial(Image.fromarray(picture))

    def model(faces):
        visual = trimesh.visual.TextureVisuals(uv, material=material)
        return read_model(trimesh.Trimesh(corners, faces, visual=visual, process=False))

    straight, mended = model(faces), model(turned)

    def pairs(one):
        both = np.concatenate([one.vertices[one.faces], one.face_uvs], 2).reshape(-1, 5)
        return both[np.lexsort(both.round(6).T)]

    np.testing.assert_allclose(pairs(straight), pairs(mended), atol=1e-9)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(None, "does not exist"), (b"solid of nothing", "cannot be read|holds no triangles")],
)
def test_what_is_no_mesh_is_refused(tmp_path, content, sentence):
    path = tmp_path / "thing.stl"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=sentence):
        read_known_object(path)


def test_a_run_is_read_with_its_mesh_and_lens(tmp_path):
    known = read_known_object(run_folder(tmp_path / "run"))
    assert known.camera is not None and known.camera.width == WIDTH
    assert known.has_colours


def test_a_folder_that_is_no_run_a_run_without_a_mesh_and_one_that_tracked_nothing_are_refused(tmp_path):
    with pytest.raises(InputError, match="not a run folder"):
        read_known_object(tmp_path)
    with pytest.raises(InputError, match=r"cannot be tracked by.*holds no features\.npz"):
        read_known_object(run_folder(tmp_path / "bare", model=False))
    with pytest.raises(InputError, match="no frame of that run was tracked"):
        read_known_object(run_folder(tmp_path / "waiting", Status.UNCERTAIN))


def test_damaged_meshes_of_runs_are_refused(tmp_path):
    folder = run_folder(tmp_path / "run")
    (folder / "features.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be tracked by"):
        read_known_object(folder)


def test_the_lens_of_the_run_is_taken_over_where_it_was_told_and_fits(tmp_path):
    given = Camera.from_fov(WIDTH, HEIGHT, 30, "given field of view of 30 degrees")
    path = str(run_folder(tmp_path / "run", camera=given))
    config = load_config(object={"model": path})
    taken = select_camera(config, WIDTH, HEIGHT, None, "")
    assert taken.fov == pytest.approx(30) and not taken.assumed and path in taken.origin
    assert select_camera(config, WIDTH + 2, HEIGHT, None, "").assumed
    assert (
        select_camera(load_config(object={"model": path}, camera={"fov": 50}), WIDTH, HEIGHT, None, "").fov
        == 50
    )
    assert select_camera(config, WIDTH, HEIGHT, (90.0, 90.0, 40.0, 30.0), "EXIF").origin == "EXIF"
    description = json.loads((tmp_path / "run/run.json").read_bytes())
    description["camera"]["assumed"] = True
    (tmp_path / "run/run.json").write_text(json.dumps(description))
    assert select_camera(config, WIDTH, HEIGHT, None, "").assumed
    # What nobody gave, but the run has solved, is known too.
    description["camera"]["origin"] = given.with_solved_focal(1.0).origin
    (tmp_path / "run/run.json").write_text(json.dumps(description))
    solved = select_camera(config, WIDTH, HEIGHT, None, "")
    assert solved.fov == pytest.approx(30) and not solved.assumed and "solved" in solved.origin


def test_a_known_shape_is_held_and_said_once():
    settings = load_config(object={"model": "runs/thing"}, quality="best").object
    assert settings.texture_views == settings.adjustment_views == 0
    with pytest.raises(InputError, match="flat or not"):
        load_known_object(load_config(object={"model": "runs/thing", "flat": True}))
    with pytest.raises(InputError, match="the solver paper"):
        load_known_object(load_config(preset="paper", object={"model": "runs/thing"}))
    assert load_known_object(load_config()) is None
