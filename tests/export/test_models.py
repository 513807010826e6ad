"""The object as GLB, PLY and STL, and moving before a camera as animated GLB and USDZ."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d.results.mesh_export import export_mesh, find_seen_faces, load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import longest_side

UPRIGHT = np.diag([1.0, -1.0, -1.0])
VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
    .then(report => console.log(JSON.stringify(report.issues)));
"""


def gltf_of(path: Path) -> tuple[dict, bytes]:
    """Tree and buffer of a GLB."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def values_of(tree: dict, buffer: bytes, accessor: int) -> np.ndarray:
    one = tree["accessors"][accessor]
    view = tree["bufferViews"][one["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[one["type"]]
    assert one["componentType"] == 5126
    flat = np.frombuffer(buffer, "<f4", one["count"] * width, view["byteOffset"] + one.get("byteOffset", 0))
    return flat.reshape(-1, width)


def test_glb_stands_upright_in_metres(export, run):
    scene = trimesh.load_scene(export(run, "glb", "out.glb", object_size=0.25))
    mesh = scene.to_mesh()
    assert longest_side(mesh.vertices) == pytest.approx(0.25, rel=1e-5)
    own = RunReader(run).mesh()
    scale = 0.25 / longest_side(np.asarray(own.vertices))
    np.testing.assert_allclose(mesh.bounds, np.sort(own.bounds @ UPRIGHT * scale, axis=0), atol=1e-6)
    assert {"tracking3d_object", "tracking3d_y_up"} <= set(scene.graph.nodes)


@pytest.mark.parametrize("to", ["glb", "animated-glb"])
def test_a_glb_says_whether_its_unit_is_the_metre(export, run, to):
    extras = [asset_of(export(run, to, f"{s}.glb", object_size=s))["extras"] for s in (None, 0.25)]
    assert extras[0]["unit"] == "unknown" and "not in metres" in extras[0]["note"]
    assert extras[1] == {"unit": "metre"}


def test_a_usdz_says_whether_its_unit_is_the_metre(export, run):
    pxr = pytest.importorskip("pxr.Usd")
    stages = [pxr.Stage.Open(str(export(run, "usdz", f"{s}.usdz", object_size=s))) for s in (None, 0.25)]
    layers = [stage.GetRootLayer() for stage in stages]  # which live as long as their stages
    assert [layer.customLayerData["tracking3d:unit"] for layer in layers] == ["unknown", "metre"]
    assert "not in metres" in layers[0].comment and layers[1].comment == "Lengths are in metres."


@pytest.fixture
def half_seen(run, tmp_path):
    """The run with a model of whose texture the left half was seen."""
    folder = shutil.copytree(run, tmp_path / "half_seen")
    model = load_model(folder)
    weight = model.texture_weight * (np.arange(model.texture_weight.shape[1]) < 16)
    export_mesh(folder, replace(model, texture_weight=weight.astype(np.float32)))
    return folder


def test_what_no_frame_has_shown_is_marked_or_cut(export, half_seen):
    run, seen = half_seen, find_seen_faces(load_model(half_seen))
    assert 0 < seen.sum() < len(seen)
    whole, cut = (export(run, "ply", f"{unseen}.ply", unseen=unseen) for unseen in ("close", "cut"))
    read = [trimesh.load_mesh(one, process=False) for one in (whole, cut)]
    assert [len(mesh.faces) for mesh in read] == [len(seen), seen.sum()]
    marks = read[0].metadata["_ply_raw"]["vertex"]["data"]["seen"]
    assert set(np.unique(marks)) == {0, 1}
    assert (
        len(trimesh.load_mesh(export(run, "stl", "cut.stl", unseen="cut"), process=False).faces) == seen.sum()
    )


def test_a_usdz_has_a_subset_of_what_no_frame_has_shown(export, half_seen):
    pxr, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    stage = pxr.Stage.Open(str(export(half_seen, "usdz", "out.usdz")))
    subset = geometry.Subset(stage.GetPrimAtPath("/tracking3d/object/mesh/unseen"))
    unseen = np.flatnonzero(~find_seen_faces(load_model(half_seen)))
    np.testing.assert_array_equal(np.array(subset.GetIndicesAttr().Get()), unseen)


def asset_of(file: Path) -> dict:
    data = file.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["asset"]


@pytest.mark.parametrize("to", ["ply", "stl"])
def test_ply_and_stl_are_in_object_coordinates(export, run, to):
    mesh = trimesh.load_mesh(export(run, to, f"out.{to}"))
    own = RunReader(run).mesh()
    np.testing.assert_allclose(mesh.bounds, own.bounds, atol=1e-5)
    assert mesh.volume == pytest.approx(own.volume, rel=1e-4)
    assert mesh.volume > 0
    if to == "ply":
        assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 10


def test_animated_glb_moves_the_object_before_the_camera(export, run, silhouettes):
    path = export(run, "animated-glb", "out.glb")
    tree, buffer = gltf_of(path)
    names = [node["name"] for node in tree["nodes"]]
    assert names == ["tracking3d_object", "tracking3d_camera"]
    (animation,) = tree["animations"]
    tracks = {}
    for channel in animation["channels"]:
        assert channel["target"]["node"] == 0
        sampler = animation["samplers"][channel["sampler"]]
        times = values_of(tree, buffer, sampler["input"]).ravel()
        tracks[channel["target"]["path"]] = values_of(tree, buffer, sampler["output"])
    np.testing.assert_allclose(times, np.array([0, 1, 3, 5, 6]) / 25, rtol=1e-6)

    lens = tree["cameras"][0]["perspective"]
    focal = 48 / np.tan(lens["yfov"] / 2)
    assert lens["aspectRatio"] == pytest.approx(128 / 96)
    K = np.array([[focal, 0, 63.5], [0, focal, 47.5], [0, 0, 1]])
    # trimesh leaves the object where it rests: at its pose in the first frame.
    mesh = trimesh.load_scene(path).geometry["tracking3d_object"]
    for time, place, turn in zip(times, tracks["translation"], tracks["rotation"], strict=True):
        T_view_obj = np.eye(4)
        T_view_obj[:3, :3] = Rotation.from_quat(turn).as_matrix()
        T_view_obj[:3, 3] = place
        T_cam_obj = np.diag([1, -1, -1, 1]) @ T_view_obj
        silhouettes(run).agree(round(25 * time), K, T_cam_obj, mesh.vertices, mesh.faces)
    assert ((tracks["rotation"][1:] * tracks["rotation"][:-1]).sum(1) > 0).all()


@pytest.mark.parametrize("to", ["glb", "animated-glb"])
def test_the_khronos_validator_finds_nothing_wrong(export, run, to):
    node = shutil.which("node")
    found = node and subprocess.run(
        [node, "-e", "require('gltf-validator')"], capture_output=True, check=False
    )
    if not found or found.returncode:
        pytest.skip("node with the package gltf-validator is not installed")
    path = export(run, to, "out.glb")
    told = subprocess.run([node, "-e", VALIDATE, str(path)], capture_output=True, text=True, check=True)
    issues = json.loads(told.stdout)
    assert issues["messages"] == [], issues


def test_usd_reads_the_scene_back(export, shifted_run, silhouettes):
    pxr = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdValidation

    stage = pxr.Stage.Open(str(export(shifted_run, "usdz", "out.usdz", object_size=1.0)))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (25, 0, 6)
    moving = UsdGeom.Xformable(stage.GetPrimAtPath("/tracking3d/object"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/tracking3d/object/mesh"))
    vertices = np.array(mesh.GetPointsAttr().Get())
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert longest_side(vertices.astype(float)) == pytest.approx(1, rel=1e-5)
    for index in range(7):
        hidden = moving.ComputeVisibility(index) == UsdGeom.Tokens.invisible
        assert hidden == (index in (2, 4))
        if not hidden:
            # USD's matrices act on rows.
            T_view_obj = np.array(moving.GetLocalTransformation(index)).T
            T_cam_obj = np.diag([1, -1, -1, 1]) @ T_view_obj
            K = lens_of(UsdGeom.Camera(stage.GetPrimAtPath("/tracking3d/camera")).GetCamera(index))
            silhouettes(shifted_run).agree(index, K, T_cam_obj, vertices, faces)


def lens_of(camera) -> np.ndarray:
    """The lens as USD's own projection has it."""
    P = np.array(camera.frustum.ComputeProjectionMatrix()).T  # to x and y from -1 to 1
    to_pixels = np.array([[64, 0, 63.5], [0, -48, 47.5], [0, 0, 1]])
    # Of (x, y, -z) in view axes the projection takes rows 0, 1 and 3.
    return to_pixels @ P[[0, 1, 3]][:, :3] @ np.diag([1, -1, -1])
