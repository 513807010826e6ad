"""Scenes for Blender, After Effects, Nuke, rerun and ROS: what they say of poses gives the masks of the run."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import trimesh
from PIL import Image as Pillow
from scipy.spatial.transform import Rotation

from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.options import ExportOptions
from tracking3d.export.ros_bag import START, start_time
from tracking3d.results.correspondences import project_object_points
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader

POSED = [0, 1, 3, 5, 6]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From axes with y up and z backward to ours."""


def rigid(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def test_blender_is_given_the_numbers_of_its_own_camera(export, shifted_run, silhouettes):
    folder = export(shifted_run, "blender")
    numbers = json.loads((folder / "scene.json").read_text())
    assert (numbers["fps"], numbers["first"], numbers["last"], numbers["hidden"]) == (25, 0, 6, [2, 4])
    assert [pose["frame"] for pose in numbers["poses"]] == POSED
    # Blender's camera looks along -z with y up; ours in its world looks along y with z up.
    T_world_view = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    for pose in numbers["poses"]:
        T_cam_obj = FLIP @ np.linalg.inv(T_world_view) @ np.array(pose["matrix_world"])
        fx = pose["lens"] / numbers["sensor_width"] * 128
        fy = fx / numbers["pixel_aspect"]
        # A lens shifted by one is shifted by the width of the picture.
        cx, cy = 63.5 - 128 * pose["shift_x"], 47.5 + 128 * pose["shift_y"] / numbers["pixel_aspect"]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        silhouettes(shifted_run).agree(pose["frame"], K, T_cam_obj, numbers["vertices"], numbers["faces"])
    script = (folder / "scene.py").read_text()
    compile(script, "scene.py", "exec")
    assert (folder / numbers["texture"]).is_file()
    assert numbers["video"] == str(shifted_run.parent / "video" / "000.png")


LOOK = """
import json, runpy, sys
import bpy
from bpy_extras.object_utils import world_to_camera_view
bpy.ops.wm.read_factory_settings(use_empty=True)
runpy.run_path(sys.argv[1], run_name="__main__")
scene = bpy.data.scenes["tracking3d"]
thing = bpy.data.objects["tracking3d_object"]
seen = {}
for frame in range(scene.frame_start, scene.frame_end + 1):
    scene.frame_set(frame)
    corners = [thing.matrix_world @ vertex.co for vertex in thing.data.vertices]
    seen[frame] = None if thing.hide_render else [
        list(world_to_camera_view(scene, scene.camera, corner))[:2] for corner in corners
    ]
json.dump(seen, open(sys.argv[2], "w"))
"""


def test_blender_builds_the_scene(export, shifted_run, tmp_path):
    python = os.environ.get("PYTHON_WITH_BPY") or (sys.executable if find_spec("bpy") else None)
    if python is None:
        pytest.skip("bpy is not installed here, and PYTHON_WITH_BPY names no Python that has it")
    folder = export(shifted_run, "blender")
    told = tmp_path / "seen.json"
    subprocess.run([python, "-c", LOOK, folder / "scene.py", told], check=True, capture_output=True)
    seen, reader = json.loads(told.read_text()), RunReader(shifted_run)
    vertices = load_model(shifted_run).vertices
    assert [int(frame) for frame, places in seen.items() if places is not None] == POSED
    for record in (one for one in reader.frames if one.index in POSED):
        pixels, _ = project_object_points(reader.camera, record.T_cam_obj, vertices)
        places = np.array(seen[str(record.index)])  # from the lower left to the upper right corner
        np.testing.assert_allclose(places[:, 0] * 128 - 0.5, pixels[:, 0], atol=0.01)
        np.testing.assert_allclose((1 - places[:, 1]) * 96 - 0.5, pixels[:, 1], atol=0.01)


AFTER_EFFECTS = """
const fs = require('fs');
const told = {};
const layer = name => {
    told[name] = {};
    const property = key => ({
        setValue: value => { told[name][key] = value; },
        setValuesAtTimes: (times, values) => { told[name][key] = {times, values}; },
    });
    return {property: group => ({property: key => property(`${group}/${key}`)})};
};
global.AutoOrientType = {NO_AUTO_ORIENT: 'none'};
const comp = {
    layers: {addCamera: () => layer('camera'), addNull: () => layer('object')},
    openInViewer: () => {},
};
global.app = {
    beginUndoGroup: () => {}, endUndoGroup: () => {},
    project: {items: {addComp: (name, width, height, aspect, duration, fps) => {
        told.comp = {name, width, height, aspect, duration, fps};
        return comp;
    }}},
};
eval(fs.readFileSync(process.argv[1], 'utf8'));
console.log(JSON.stringify(told));
"""
"""A stand-in for what After Effects gives to scripts, which keeps what it is told."""


def test_after_effects_is_told_where_the_null_is(export, run, silhouettes):
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    path = export(run, "after-effects", "out.jsx")
    told = json.loads(
        subprocess.run([node, "-e", AFTER_EFFECTS, path], capture_output=True, text=True, check=True).stdout
    )
    assert told["comp"]["fps"] == 25
    assert told["comp"]["duration"] == pytest.approx(7 / 25)
    place, zooms = "ADBE Transform Group/ADBE", told["camera"]["ADBE Camera Options Group/ADBE Camera Zoom"]
    assert told["camera"][f"{place} Position"] == told["object"][f"{place} Anchor Point"] == [0, 0, 0]
    positions, angles = told["object"][f"{place} Position"], told["object"][f"{place} Orientation"]
    mesh = RunReader(run).mesh()
    for time, zoom, position, (a, b, c) in zip(
        positions["times"],
        zooms["values"],
        positions["values"],
        angles["values"],
        strict=True,
    ):
        turns = [
            Rotation.from_euler(axis, angle, degrees=True)
            for axis, angle in zip("xyz", (a, b, c), strict=True)
        ]
        R = (turns[0] * turns[1] * turns[2]).as_matrix()
        K = np.array([[zoom, 0, 63.5], [0, zoom, 47.5], [0, 0, 1]])
        T = rigid(R, np.array(position) / 1000)
        silhouettes(run).agree(round(25 * time), K, T, mesh.vertices, mesh.faces)


def test_nuke_has_either_a_moving_camera_or_a_moving_object(export, run, silhouettes):
    folder = export(run, "nuke")
    camera, moving = (np.loadtxt(folder / f"{name}_moves.chan") for name in ("camera", "object"))
    mesh = trimesh.load_mesh(folder / "mesh.obj")
    for row, of_camera in (
        (row, of_camera) for of_camera, rows in ((0, moving), (1, camera)) for row in rows
    ):
        x, y, z = (
            Rotation.from_euler(axis, angle, degrees=True)
            for axis, angle in zip("xyz", row[4:7], strict=True)
        )
        T = rigid((y * x * z).as_matrix(), row[1:4])  # ZXY: z is turned about first
        T_view_mesh = np.linalg.inv(T) if of_camera else T
        focal = 48 / np.tan(np.radians(camera[0, 7]) / 2)
        K = np.array([[focal, 0, 63.5], [0, focal, 47.5], [0, 0, 1]])
        silhouettes(run).agree(int(row[0]), K, FLIP @ T_view_mesh, mesh.vertices, mesh.faces)
    assert camera[:, 0].tolist() == moving[:, 0].tolist() == POSED
    assert (folder / "texture.png").is_file()


def test_rosbags_reads_poses_and_cameras(export, shifted_run, silhouettes):
    pytest.importorskip("rosbags")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    folder = export(shifted_run, "ros-bag")
    mesh = RunReader(shifted_run).mesh()
    lenses, poses, transforms = {}, {}, {}
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        for connection, stamp, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            index = round((stamp - 1e9) * 25 / 1e9)  # a video that does not say when it was recorded
            if connection.topic == "/tf":
                (one,) = message.transforms
                assert one.child_frame_id == "tracking3d_object"
                transforms[index] = one.transform
                continue
            assert message.header.frame_id == "tracking3d_camera_optical"
            (lenses if connection.topic == "/tracking3d/camera_info" else poses)[index] = message
    assert sorted(lenses) == [0, 1, 2, 3, 5, 6]
    assert sorted(poses) == sorted(transforms) == POSED
    for index, message in poses.items():
        place, turn = message.pose.position, message.pose.orientation
        T = rigid(
            Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(), [place.x, place.y, place.z]
        )
        silhouettes(shifted_run).agree(index, lenses[index].k.reshape(3, 3), T, mesh.vertices, mesh.faces)
        assert transforms[index].translation.z == place.z


def recorded(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """The messages of a bag with their stamps, by topic."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        for connection, stamp, raw in bag.messages():
            found.setdefault(connection.topic, []).append((stamp, bag.deserialize(raw, connection.msgtype)))
    return found


def test_stamps_begin_at_a_positive_time_that_may_be_chosen(export, run):
    pytest.importorskip("rosbags")
    for name, options, start in [
        ("plain", {}, 1.0),
        ("chosen", {"start_time": 1_700_000_000.25}, 1_700_000_000.25),
    ]:
        stamped = recorded(export(run, "ros-bag", name, **options))["/tracking3d/pose"]
        first, message = stamped[0]
        assert first == round(start * 1e9)
        assert message.header.stamp.sec + message.header.stamp.nanosec / 1e9 == pytest.approx(start)
        assert stamped[1][0] - first == pytest.approx(4e7, abs=1)  # 25 frames a second


def test_stamps_begin_when_the_video_was_recorded(run, tmp_path):
    container = av.open(str(tmp_path / "clip.mp4"), "w")
    container.metadata["creation_time"] = "2026-11-25T12:00:00Z"
    stream = container.add_stream("libx264", rate=10)
    stream.width, stream.height = 64, 48
    for packet in [*stream.encode(av.VideoFrame(64, 48, "yuv420p")), *stream.encode()]:
        container.mux(packet)
    container.close()
    moment = datetime(2026, 11, 25, 12, tzinfo=UTC).timestamp()
    reader = RunReader(run)
    assert start_time(ExportedRun(reader, ExportOptions(source=str(tmp_path / "clip.mp4")))) == moment
    assert start_time(ExportedRun(reader, ExportOptions(source=str(tmp_path / "absent.mp4")))) == START
    assert start_time(ExportedRun(reader, ExportOptions(start_time=5.0))) == 5.0


def test_images_are_included_if_asked_for(export, run):
    pytest.importorskip("rosbags")
    assert "/tracking3d/image/compressed" not in recorded(export(run, "ros-bag", "without"))
    messages = recorded(export(run, "ros-bag", "with", compressed_images=True))
    images = messages["/tracking3d/image/compressed"]
    assert [stamp for stamp, _ in images] == [stamp for stamp, _ in messages["/tracking3d/camera_info"]]
    _, one = images[0]
    assert one.format == "jpeg" and one.header.frame_id == "tracking3d_camera_optical"
    seen = np.asarray(Pillow.open(io.BytesIO(one.data.tobytes())).convert("RGB"), float)
    given = np.asarray(Pillow.open(RunReader(run).description["source"] + "/000.png"), float)
    assert np.corrcoef(seen.ravel(), given.ravel())[0, 1] > 0.6  # of noise, which JPEG blurs


def test_mcap_holds_the_messages_of_the_bag_and_their_definitions(export, run):
    pytest.importorskip("rosbags")
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    bag = recorded(export(run, "ros-bag", "bag", compressed_images=True))
    file = export(run, "mcap", "run.mcap", compressed_images=True)
    assert file.is_file()
    found: dict[str, list[int]] = {}
    with file.open("rb") as stream:
        for _, channel, message, decoded in reader.make_reader(
            stream, decoder_factories=[decoder.DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message.log_time)
            if channel.topic == "/tracking3d/pose":
                index = found[channel.topic].index(message.log_time)
                assert decoded.pose.position.z == bag[channel.topic][index][1].pose.position.z
    assert found == {topic: [stamp for stamp, _ in messages] for topic, messages in bag.items()}


READ_RECORDING = """
import json, sys
from rerun.chunk import RrdReader
told = {}
for chunk in RrdReader(sys.argv[1]).stream():
    batch = chunk.to_record_batch()
    names = [name for name in batch.schema.names if "Transform3D" in name or name == "frame"]
    told.setdefault(str(chunk.entity_path), []).extend(batch.select(names).to_pylist())
print(json.dumps(told))
"""


def test_rerun_reads_its_recording(export, run, silhouettes):
    pytest.importorskip("rerun.chunk")
    path = export(run, "rerun", "out.rrd")
    # In a process of its own: the recorder starts threads.
    read = subprocess.run(
        [sys.executable, "-c", READ_RECORDING, path], capture_output=True, text=True, check=True
    )
    told = json.loads(read.stdout)
    answered = [0, 1, 2, 3, 5, 6]
    for entity in ("/camera/image", "/camera/mask", "/confidence", "/status"):
        assert [row["frame"] for row in told[entity]] == answered, entity
    reader = RunReader(run)
    mesh = reader.mesh()
    moved = [row for row in told["/camera/object"] if "frame" in row]
    assert [row["frame"] for row in moved] == POSED
    for row in moved:
        (columns,), (place,) = row["Transform3D:mat3x3"], row["Transform3D:translation"]
        T = rigid(np.reshape(columns, (3, 3)).T, place)
        silhouettes(run).agree(row["frame"], reader.camera.K, T, mesh.vertices, mesh.faces)


def test_supervision_has_the_mask_as_a_detection(run):
    pytest.importorskip("supervision")
    from tracking3d.export.supervision_detections import detections

    reader = RunReader(run)
    found = detections(reader, 3)
    np.testing.assert_array_equal(found.mask[0], reader.mask(3))
    x0, y0, x1, y1 = found.xyxy[0].astype(int)
    assert reader.mask(3)[y0 : y1 + 1, x0 : x1 + 1].sum() == reader.mask(3).sum()
    assert found.confidence[0] == pytest.approx(0.65)
    np.testing.assert_allclose(found.data["T_cam_obj"][0], reader.frames[3].T_cam_obj)
    assert len(detections(reader, 4)) == 0
