"""The node without ROS: what goes in as messages comes out as messages, and no message stops it."""

from __future__ import annotations

import ast
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status

pytest.importorskip("tracking3d_ros2", reason="the plug-in tracking3d-ros2 is not installed")

from tracking3d_ros2.node import TrackingNode, main
from tracking3d_ros2.tracking import CHANNELS, ObjectTracking, rgb_of

ROOT = Path(__file__).resolve().parents[1]
P = [400.0, 0, 31.5, 0, 0, 410.0, 23.5, 0, 0, 0, 1, 0]
IMAGE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)


class Played:
    """A tracker whose answers are known: the object is two units long."""

    def __init__(self, statuses: str, started: list) -> None:
        self.statuses, self.started, self.seen = statuses, started, 0

    def begin(self, frame, box, lens):
        self.started.append((frame.index, box, lens))
        if box[2] <= 0:
            raise InputError("The box has no size.")
        return self

    def step(self, frame) -> FrameEstimate:
        status = {"t": Status.TRACKED, "u": Status.UNCERTAIN, "l": Status.LOST}[self.statuses[self.seen]]
        self.seen += 1
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec((0, 0.3, 0)).as_matrix()
        T[:3, 3] = 1, 2, 8
        mask = np.zeros((48, 64), bool)
        mask[10:20, 30:40] = True
        return FrameEstimate(
            frame.index, None, T, mask, mask, status, "" if status == "tracked" else "why", 0.8
        )

    def result(self) -> ObjectModel:
        box = trimesh.creation.box((2, 0.5, 0.7))
        texture = np.full((4, 4, 3), 51, np.uint8)
        uvs = np.full((*box.faces.shape, 2), 0.5)
        return ObjectModel(box.vertices, box.faces, uvs, texture, np.ones((4, 4)), texture / 255)


@pytest.fixture
def started() -> list:
    return []


def tracking(statuses: str, started: list, **options: Any) -> ObjectTracking:
    made = ObjectTracking(begin=Played(statuses, started).begin, **options)
    made.lens(P, [])
    return made


def test_positions_are_metres_and_quaternions_end_with_w(started):
    answer = tracking("t", started, box=(1, 2, 3, 4), object_size=0.5).picture(IMAGE)
    np.testing.assert_allclose(answer.position, np.array([1, 2, 8]) * 0.5 / 2)
    np.testing.assert_allclose(answer.quaternion, [0, np.sin(0.15), 0, np.cos(0.15)])
    assert answer.mask.sum() == 100 * 255
    assert (answer.level, answer.message, answer.values["confidence"]) == (0, "tracked", "0.800")
    assert started == [(0, (1, 2, 3, 4), (400, 410, 31.5, 23.5))]


def test_without_a_size_the_unit_is_the_trackers(started):
    answer = tracking("t", started, box=(1, 2, 3, 4)).picture(IMAGE)
    np.testing.assert_allclose(answer.position, (1, 2, 8))


def test_what_is_not_tracked_has_a_mask_and_no_pose(started):
    node = tracking("ul", started, box=(1, 2, 3, 4))
    answers = [node.picture(IMAGE) for _ in range(2)]
    assert [(one.level, one.message, one.position) for one in answers] == [(1, "why", None), (2, "why", None)]
    assert all(one.mask is not None for one in answers)


def test_it_waits_for_the_lens_and_for_the_object(started):
    node = ObjectTracking(begin=Played("t", started).begin)
    assert "camera_info" in node.picture(IMAGE).message
    node.lens([0.0] * 12, [500.0, 0, 1, 0, 500.0, 2, 0, 0, 1])
    assert "region" in node.picture(IMAGE).message
    node.region((5, 6, 7, 8))
    assert node.picture(IMAGE).level == 0
    assert started == [(0, (5, 6, 7, 8), (500, 500, 1, 2))]


def test_a_region_begins_anew_and_a_bad_one_is_told_and_waited_for_again(started):
    node = tracking("tttt", started, box=(1, 2, 3, 4))
    node.picture(IMAGE)
    node.region((1, 1, 0, 0))
    answer = node.picture(IMAGE)
    assert (answer.level, answer.message) == (2, "The box has no size.")
    assert "waiting for the object" in node.picture(IMAGE).message
    node.region((9, 9, 9, 9))
    assert node.picture(IMAGE).level == 0
    assert [box for _, box, _ in started] == [(1, 2, 3, 4), (1, 1, 0, 0), (9, 9, 9, 9)]


def test_the_mesh_comes_now_and_then_in_metres_with_colours(started):
    node = tracking("t" * 7, started, box=(1, 2, 3, 4), object_size=0.5, mesh_every=3)
    meshes = [node.picture(IMAGE).mesh for _ in range(7)]
    assert [mesh is not None for mesh in meshes] == [False, False, False, True, False, False, True]
    assert np.ptp(meshes[3].corners, axis=0).max() == pytest.approx(0.5)
    assert meshes[3].corners.shape == meshes[3].colours.shape == (36, 3)
    assert (meshes[3].colours == 0.2).all()


@pytest.mark.parametrize("encoding", CHANNELS)
def test_pictures_of_every_encoding_with_padded_rows(encoding):
    size = {"mono8": 1, "rgba8": 4, "bgra8": 4}.get(encoding, 3)
    pixels = IMAGE[..., :1] if size == 1 else IMAGE[..., ::-1] if encoding[0] == "b" else IMAGE
    if size == 4:
        pixels = np.concatenate([pixels, np.full((48, 64, 1), 7, np.uint8)], axis=2)
    padded = np.pad(pixels.reshape(48, -1), ((0, 0), (0, 5)))
    read = rgb_of(padded.tobytes(), 48, 64, 64 * size + 5, encoding)
    np.testing.assert_array_equal(read, np.repeat(IMAGE[..., :1], 3, 2) if size == 1 else IMAGE)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((b"", 4, 4, 12, "rgb8"), "too few"),
        ((b"x" * 99, 4, 4, 3, "rgb8"), "too few"),
        ((b"", 1, 1, 2, "16UC1"), "16UC1"),
    ],
)
def test_a_picture_that_is_none_is_told(arguments, words):
    with pytest.raises(InputError, match=words):
        rgb_of(*arguments)


def test_options_that_cannot_be_used_are_told():
    for wrong in ({"object_size": -1.0}, {"mesh_every": -1}, {"object_size": float("nan")}):
        with pytest.raises(InputError, match="object_size"):
            ObjectTracking(**wrong)


class Message(SimpleNamespace):
    """A message that has whatever it is asked for."""

    TRIANGLE_LIST, ADD = 11, 0

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = Message()
        setattr(self, name, value)
        return value


class FakeNode:
    """Keeps what was subscribed and published, as an rclpy node does."""

    def __init__(self, **parameters: Any) -> None:
        self.given, self.callbacks, self.published = parameters, {}, {}

    def declare_parameter(self, name: str, value: Any) -> Any:
        return SimpleNamespace(value=self.given.get(name, value))

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def create_subscription(self, kind: Any, topic: str, callback: Any, quality: Any) -> None:
        self.callbacks[topic] = callback


KINDS = """CameraInfo ColorRGBA DiagnosticArray DiagnosticStatus Image KeyValue Marker Point PoseStamped
    RegionOfInterest newest"""


def image_message(encoding: str = "rgb8") -> Message:
    header = Message(stamp=Message(sec=3, nanosec=500_000_000), frame_id="camera")
    return Message(header=header, data=IMAGE.tobytes(), height=48, width=64, step=192, encoding=encoding)


def test_messages_in_messages_out(started):
    fake = FakeNode()
    played = ObjectTracking((1, 2, 3, 4), 0.5, 1, begin=Played("ttlt", started).begin)
    TrackingNode(fake, dict.fromkeys(KINDS.split(), Message), played)
    fake.callbacks["camera_info"](Message(p=P, k=[]))
    for _ in range(3):
        fake.callbacks["image"](image_message())
    fake.callbacks["image"](image_message("yuv422"))
    [first, _] = fake.published["~/pose"]
    assert (first.header.frame_id, first.pose.position.z, first.pose.orientation.x) == ("camera", 2.0, 0.0)
    masks = fake.published["~/mask"]
    assert [(one.width, one.height, one.encoding, len(one.data)) for one in masks] == [
        (64, 48, "mono8", 3072)
    ] * 3
    [marker] = fake.published["~/mesh"]
    assert (len(marker.points), len(marker.colors), marker.type) == (36, 36, 11)
    levels = [one.status[0].level for one in fake.published["~/diagnostics"]]
    assert levels == [b"\0", b"\0", b"\2", b"\2"]
    assert "yuv422" in fake.published["~/diagnostics"][-1].status[0].message
    fake.callbacks["~/region"](Message(x_offset=4, y_offset=5, width=6, height=7))
    fake.callbacks["image"](image_message())
    assert len(fake.published["~/pose"]) == 3
    assert started[-1][1] == (4, 5, 6, 7)


def test_parameters_are_read_and_checked():
    messages = dict.fromkeys(KINDS.split(), Message)
    TrackingNode(FakeNode(box="1,2,30,40", quality="draft"), messages)
    with pytest.raises(InputError, match="box"):
        TrackingNode(FakeNode(box="1,2"), messages)


def test_without_ros_the_program_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(SystemExit, match=r"needs ROS 2: source its setup\.bash"):
        main()


def test_the_package_is_what_ros_expects():
    tree = ElementTree.parse(ROOT / "package.xml").getroot()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert tree.findtext("name") == project["name"].replace("-", "_") == "tracking3d_ros2"
    assert tree.findtext("version") == project["version"]
    assert tree.findtext("license") == project["license"]
    assert tree.findtext("export/build_type") == "ament_python"
    needed = {one.text for one in tree.findall("exec_depend")}
    imported = set()
    for path in (*ROOT.glob("tracking3d_ros2/*.py"), *ROOT.glob("launch/*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                imported.add(node.module.split(".")[0])
    assert {name for name in imported if name.endswith("_msgs") or "launch" in name} <= needed
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    for name in ("resource/tracking3d_ros2", "package.xml", "launch/tracking3d.launch.py"):
        assert (ROOT / name).exists() and f'"{name}"' in setup
    assert "tracking3d_node" in project["scripts"]
    assert 'executable="tracking3d_node"' in (ROOT / "launch/tracking3d.launch.py").read_text()
