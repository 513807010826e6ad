"""The objects: closed, outward, of the promised size, with the promised symmetries; and mesh files of any kind."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import Delaunay

from tracking3d.errors import InputError
from tracking3d_bench.synthesis.procedural_solids import PROCEDURAL
from tracking3d_bench.synthesis.random_solids import _ASSEMBLIES
from tracking3d_bench.synthesis.ray_casting import RayMesh
from tracking3d_bench.synthesis.scene import make_solid
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.texture_lookup import bilinear


def solid(name, **more):
    return make_solid(SequenceSpec(object=str(name), **more))


def merged(made):
    """The shape with the vertices at seams joined."""
    mesh = trimesh.Trimesh(made.vertices.round(7), made.faces)
    mesh.update_faces(mesh.nondegenerate_faces())
    return mesh


@pytest.mark.parametrize("name", sorted(set(PROCEDURAL) - {"mug"}))
def test_solids_are_closed_and_their_faces_look_outward(name):
    mesh = merged(solid(name))
    assert mesh.is_watertight and mesh.volume > 0


@pytest.mark.parametrize("name", PROCEDURAL)
def test_procedural_objects_are_about_one_unit_in_radius(name):
    assert 0.8 < solid(name).radius < 1.1


@pytest.mark.parametrize("name", PROCEDURAL)
def test_texture_coordinates_lie_in_the_texture_and_every_face_has_an_own_place(name):
    made = solid(name)
    assert made.uvs.min() > 0 and made.uvs.max() < 1
    a, b, c = made.uvs[made.faces].transpose(1, 0, 2)
    area = 0.5 * np.abs(np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2])
    assert 0.2 < area.sum() <= 1  # overlapping faces would soon add up to more


@pytest.mark.parametrize("name", PROCEDURAL)
def test_textures_are_seen_upright_and_not_mirrored_from_outside(name):
    made = solid(name)
    a, b, c = made.uvs[made.faces].transpose(1, 0, 2)
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert turn.min() > -1e-12


def test_one_can_look_through_the_handle_of_the_mug_and_into_it():
    surface = RayMesh.of(solid("mug").mesh())
    ahead = np.array([[0.0, 0.0, 1.0]])
    through, handle = (surface.cast(np.array([[x, 0.0, -5.0]]), ahead).face[0] for x in (0.57, 0.7))
    assert through == -1 and handle >= 0
    bottom = surface.cast(np.array([[-0.12, 5.0, 0.0]]), np.array([[0.0, -1.0, 0.0]]))
    assert bottom.distance[0] == pytest.approx(5.52)


def test_the_sides_of_a_card_differ():
    made = solid("card")
    sides = [made.texture[256 * r : 256 * (r + 1), 256 * c : 256 * (c + 1)] for r, c in ((0, 0), (0, 1))]
    assert np.abs(sides[0].astype(int) - sides[1]).mean() > 20


SHAPES_OF_THE_SEED = {"blob", "organic", "assembly", "stick", "knob", "bowl"}


@pytest.mark.slow
def test_the_seed_changes_every_texture_and_the_shapes_that_are_drawn():
    for name in PROCEDURAL:
        one, same, other = (solid(name, seed=seed) for seed in (1, 1, 2))
        assert (one.texture == same.texture).all() and (one.vertices == same.vertices).all()
        assert not np.array_equal(one.texture, other.texture)
        assert np.array_equal(one.vertices, other.vertices) == (name not in SHAPES_OF_THE_SEED)


@pytest.mark.parametrize("name", ["organic", "assembly", "stick", "knob", "bowl"])
@pytest.mark.parametrize("seed", range(9000, 9012))
def test_shapes_of_the_seed_are_closed_in_the_middle_and_never_show_their_inside(name, seed):
    made = solid(name, seed=seed, textured=False)
    mesh = merged(made)
    assert mesh.is_watertight and mesh.volume > 0
    assert made.vertices.min(0) == pytest.approx(-made.vertices.max(0)) and made.radius == pytest.approx(0.95)
    surface = RayMesh.of(made.mesh())
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(400, 3))
    origins *= 4 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.6, 0.6, (400, 3)) - origins
    face = surface.cast(origins, directions).face
    seen = face >= 0
    facing = np.einsum("ij,ij->i", surface.face_normals[face[seen]], directions[seen])
    assert seen.sum() > 20 and facing.max() < 1e-6


def test_every_kind_of_assembly_is_in_one_piece_and_concave():
    for boxes in _ASSEMBLIES.values():
        spans = np.array(boxes)
        for seed in range(20):  # faces move by less than boxes overlap
            moved = spans + np.random.default_rng(seed).uniform(-0.02, 0.02, spans.shape)
            low, high = moved[:, :, 0], moved[:, :, 1]
            touching = (np.minimum(high[:, None], high) - np.maximum(low[:, None], low) > 0.01).all(2)
            assert np.linalg.matrix_power(touching.astype(int), len(spans)).all()
        points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
        in_a_box = ((spans[:, None, :, 0] < points) & (points < spans[:, None, :, 1])).all(2).any(0)
        corners = np.stack([spans[:, (0, 1, 2), choice] for choice in np.ndindex(2, 2, 2)]).reshape(-1, 3)
        in_the_hull = Delaunay(corners).find_simplex(points) >= 0
        assert in_a_box.sum() < 0.9 * in_the_hull.sum()


def test_a_faint_print_is_the_same_print_nearer_to_its_mean_colour():
    strong, faint, none = (solid("box", print_strength=strength).texture for strength in (1.0, 0.25, 0.0))
    assert (none == none[0, 0]).all()
    expected = none + 0.25 * (strong.astype(float) - none)
    assert np.abs(faint - expected).max() <= 1
    seen = bilinear(strong.astype(np.float32), solid("box").uvs).mean(0)
    assert np.abs(none[0, 0] - seen).max() < 60


def test_without_its_print_an_object_has_the_symmetries_of_a_plain_one():
    assert len(solid("box", print_strength=0.0).symmetries) == 4
    assert len(solid("box", print_strength=0.1).symmetries) == 1
    for made in (solid("bowl", print_strength=0.0), solid("bowl", textured=False)):
        assert made.axis == pytest.approx([0, 1, 0])
    assert solid("bowl").axis is None and solid("knob", textured=False).axis is None


def test_the_colours_of_a_mesh_file_fade_too(tmp_path):
    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.arange(8)[:, None] * [30, 20, 10] + [0, 0, 50]
    mesh.export(tmp_path / "box.ply")
    strong, faint = (solid(tmp_path / "box.ply", print_strength=strength).colours for strength in (1.0, 0.5))
    assert np.ptp(faint, axis=0) == pytest.approx(0.5 * np.ptp(strong, axis=0), abs=1)


@pytest.mark.parametrize("name", PROCEDURAL)
def test_a_textureless_object_has_nearly_one_colour(name):
    plain, printed = solid(name, textured=False).texture, solid(name).texture
    made = solid(name, textured=False)
    seen = bilinear(made.texture.astype(np.float32), made.uvs[made.faces].mean(1))
    assert np.ptp(seen, axis=0).max() < 30  # all faces, none of them blank
    painted = plain[plain.any(2)]  # a texture may have more room than panels
    assert 0.2 < painted.std(0).max() < 4
    assert printed.std((0, 1)).min() > 25
    assert (solid(name, textured=False).vertices == solid(name).vertices).all()


@pytest.mark.parametrize(
    ("name", "count"), [("box", 4), ("card", 4), ("bottle", 72), ("mug", 1), ("blob", 1)]
)
def test_the_symmetries_of_textureless_objects_map_them_to_themselves(name, count):
    made = solid(name, textured=False)
    assert made.symmetries.shape == (count, 4, 4)
    assert (made.symmetries[0] == np.eye(4)).all()
    surface = RayMesh.of(made.mesh())
    rng = np.random.default_rng(0)
    origins, directions = rng.normal(0, 5, (500, 3)), rng.normal(0, 0.3, (500, 3))
    directions -= origins
    before = surface.cast(origins, directions).distance
    for T in made.symmetries[:: max(1, count // 6)]:
        assert (T[:3, 3] == 0).all()
        after = surface.cast(origins @ T[:3, :3].T, directions @ T[:3, :3].T).distance
        assert (np.isclose(before, after, atol=0.01)).mean() > 0.98  # but for grazed outlines
    assert len(solid(name).symmetries) == 1


def test_only_the_textureless_bottle_and_the_vase_have_an_axis():
    for made in (solid("bottle", textured=False), solid("vase"), solid("vase", textured=False)):
        assert made.axis == pytest.approx([0, 1, 0]) and len(made.symmetries) == 72
    assert solid("bottle").axis is None and solid("box", textured=False).axis is None


def test_a_vase_looks_the_same_from_all_around_and_not_upside_down():
    made = solid("vase")
    surface = RayMesh.of(made.mesh())
    height = np.linspace(-0.8, 0.8, 40)

    def colours(angle, flip=1.0):
        out = np.array([np.cos(angle), 0, np.sin(angle)])
        hits = surface.cast(5 * out + flip * height[:, None] * (0.0, 1.0, 0.0), np.tile(-out, (40, 1)))
        uv = np.einsum("nc,ncd->nd", hits.weights, made.uvs[made.faces[hits.face]])
        return hits.distance, bilinear(made.texture.astype(np.float32), uv)

    (reach, print_), (turned_reach, turned_print), (_, flipped) = (
        colours(0.1),
        colours(2.7),
        colours(0.1, -1.0),
    )
    assert turned_reach == pytest.approx(reach, abs=0.003)  # it is a prism of 96 sides
    assert np.abs(turned_print - print_).mean() < 3  # texels are not level with the height to the last digit
    assert np.abs(flipped - print_).mean() > 30
    assert print_.std(0).max() > 25


def textured_mesh(folder, offset=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.box((0.1, 0.2, 0.05)).apply_translation(offset)
    texture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8))
    uv = np.random.default_rng(1).random((len(mesh.vertices), 2))
    material = trimesh.visual.material.SimpleMaterial(texture)
    mesh.visual = trimesh.visual.TextureVisuals(uv, material=material)
    mesh.export(folder / "thing.obj")
    return folder / "thing.obj", np.asarray(texture)


def test_a_mesh_file_keeps_axes_size_and_texture_and_is_centred(tmp_path):
    file, texture = textured_mesh(tmp_path, offset=(3.0, -1.0, 0.5))
    made = solid(file)
    assert (made.texture == texture).all()
    assert np.ptp(made.vertices, axis=0) == pytest.approx([0.1, 0.2, 0.05])
    assert made.vertices.min(0) == pytest.approx(-made.vertices.max(0))
    assert made.millimetres == 1000
    assert "thing.obj" in made.frame and "(3, -1, 0.5)" in made.frame
    assert len(made.faces) == 12


def test_a_mesh_with_coloured_vertices_or_no_colours_at_all_will_do(tmp_path):
    mesh = trimesh.creation.icosphere(1)
    colours = np.random.default_rng(0).integers(0, 255, (len(mesh.vertices), 4), dtype=np.uint8)
    mesh.visual.vertex_colors = colours
    mesh.export(tmp_path / "coloured.ply")
    assert (solid(tmp_path / "coloured.ply").colours == colours[:, :3]).all()
    trimesh.creation.icosphere(1).export(tmp_path / "bare.stl")
    for made in (solid(tmp_path / "bare.stl"), solid(tmp_path / "coloured.ply", textured=False)):
        assert made.texture is None and (made.colours == made.colours[0]).all()


def test_scans_are_loaded_with_all_faces_and_their_texture(shared_data):
    made = solid(shared_data / "meshes" / "035_power_drill" / "textured.obj")
    assert len(made.faces) == 5242 and made.texture.shape == (512, 512, 3)
    assert 0.1 < made.radius < 0.2


def test_an_object_that_does_not_exist_is_named_with_the_nearest_one():
    with pytest.raises(InputError, match=r"object or mesh file 'botle'.*did you mean 'bottle'"):
        solid("botle")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist"),
        (b"", "cannot be read|holds no triangles"),
        (b"\x00\xff not a mesh", "cannot be read|holds no triangles"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "cannot be read|holds no triangles"),
        (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        (b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "all its vertices at one point"),
    ],
)
def test_a_mesh_file_that_cannot_be_used_is_refused_by_name(tmp_path, content, message):
    file = tmp_path / "broken.obj"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError, match=message) as refusal:
        solid(file)
    assert "broken.obj" in str(refusal.value)
