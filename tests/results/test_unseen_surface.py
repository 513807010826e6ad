"""What no frame has shown is marked in every file, and can be left out."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.gltf_axes import read_mesh_file
from tracking3d.results.mesh_export import (
    cut_unseen,
    export_mesh,
    find_seen_faces,
    find_seen_vertices,
    glb_file,
    group_faces,
    load_mesh,
    sort_seen_first,
)


def square(count: int, seen_columns: int) -> ObjectModel:
    """A square of ``count`` x ``count`` cells, of which the first columns of the texture were seen."""
    x, y = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1) / count
    corner = (y[:-1, :-1] * (count + 1) + x[:-1, :-1]).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + count + 1], 1),
            np.stack([corner + 1, corner + count + 2, corner + count + 1], 1),
        ]
    )
    weight = np.zeros((64, 64), np.float32)
    weight[:, :seen_columns] = 1
    texture = np.full((64, 64, 3), 120, np.uint8)
    return ObjectModel(
        vertices, faces, vertices[faces][..., :2], texture, weight, np.zeros((64, 64, 1), np.float32)
    )


def parse_glb(data: bytes) -> dict:
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_a_face_is_seen_where_its_texels_are():
    model = square(8, 32)
    seen = find_seen_faces(model)
    middle = model.vertices[model.faces].mean(1)[:, 0]
    np.testing.assert_array_equal(seen, middle < 0.5)
    np.testing.assert_array_equal(find_seen_vertices(model), model.vertices[:, 0] <= 0.5)


def test_where_nobody_has_looked_everything_counts_as_seen():
    assert find_seen_faces(square(4, 0)).all()


def test_texture_coordinates_beyond_the_seam_wrap():
    model = square(8, 32)
    beyond = replace(model, face_uvs=model.face_uvs + np.array([1, 0]))
    np.testing.assert_array_equal(find_seen_faces(beyond), find_seen_faces(model))


def test_the_glb_has_a_pale_primitive_of_all_unseen_faces_and_of_no_others():
    model = square(8, 32)
    tree = parse_glb(glb_file(model))
    (mesh,) = tree["meshes"]
    seen, unseen = mesh["primitives"]
    counts = [tree["accessors"][one["indices"]]["count"] for one in (seen, unseen)]
    assert counts == [3 * find_seen_faces(model).sum(), 3 * (~find_seen_faces(model)).sum()]
    material = tree["materials"][unseen["material"]]
    assert material["name"] == "unseen" and "baseColorTexture" not in material["pbrMetallicRoughness"]
    assert tree["materials"][seen["material"]]["name"] == "texture"


def test_both_primitives_together_are_the_surface(tmp_path):
    model = square(8, 32)
    (tmp_path / "model.glb").write_bytes(glb_file(model))
    assert len(trimesh.load_scene(tmp_path / "model.glb", process=False).geometry) == 2
    mesh, expected = read_mesh_file(tmp_path / "model.glb"), sort_seen_first(model)[0]
    assert np.allclose(mesh.vertices[mesh.faces], expected.vertices[expected.faces], atol=1e-6)
    assert np.allclose(mesh.visual.uv[mesh.faces] * [1, -1] + [0, 1], expected.face_uvs, atol=1e-6)
    assert np.array_equal(np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")), model.texture)


@pytest.mark.parametrize("columns", [0, 64])
def test_a_model_that_is_seen_all_round_has_one_primitive(columns):
    (mesh,) = parse_glb(glb_file(square(4, columns)))["meshes"]
    assert len(mesh["primitives"]) == 1


def test_the_obj_has_groups_and_reads_back_in_the_model_s_order(tmp_path):
    model = square(8, 32)
    export_mesh(tmp_path, model)
    text = (tmp_path / "mesh.obj").read_text()
    assert "g unseen\n" in text and "g seen\n" in text
    mesh = load_mesh(tmp_path)
    assert np.allclose(mesh.vertices[mesh.faces], model.vertices[model.faces], atol=1e-6)
    group, unseen = "", []
    for line in text.splitlines():
        group = line[2:] if line.startswith("g ") else group
        unseen += [group == "unseen"] * line.startswith("f ")
    np.testing.assert_array_equal(~np.array(unseen), find_seen_faces(model))


def test_an_obj_without_unseen_faces_stays_as_it_is():
    assert group_faces("f 1 2 3\nf 1 3 4", np.ones(2, bool)) == "f 1 2 3\nf 1 3 4"


def test_a_cut_model_has_its_seen_faces_alone():
    model = square(8, 32)
    cut = cut_unseen(model)
    np.testing.assert_array_equal(cut.faces, model.faces[find_seen_faces(model)])
    assert len(cut.face_uvs) == len(cut.faces)
