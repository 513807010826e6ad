"""The nanotrack plug-in with networks of NanoTrack's sizes but a few numbers, and with NanoTrack where it is."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tracking3d_nanotrack import NanoTracker

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.testing import check_tracker
from tracking3d.testing.trackers import moving_disc

onnx = pytest.importorskip("onnx")
node, value, FLOAT = onnx.helper.make_node, onnx.helper.make_tensor_value_info, onnx.TensorProto.FLOAT
SHARED = Path(__file__).resolve().parents[4] / "shared"


def save(file: Path, nodes: list, inputs: list, outputs: list, constants: dict) -> str:
    weights = [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = onnx.helper.make_graph(nodes, "small", inputs, outputs, weights)
    opsets = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8), str(file))
    return str(file)


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The highest score is always in the middle of the search region: the box stays about where it is."""
    folder = tmp_path_factory.mktemp("networks")
    backbone = save(
        folder / "backbone.onnx",
        [
            node("AveragePool", ["input"], ["blocks"], kernel_shape=[16, 16], strides=[16, 16],
                 pads=[0, 0, 1, 1]),
            node("Conv", ["blocks", "weights"], ["output"]),
        ],
        [value("input", FLOAT, [1, 3, 255, 255])],
        [value("output", FLOAT, [1, 48, 16, 16])],
        {"weights": np.full((48, 3, 1, 1), 1e-3, np.float32)},
    )  # fmt: skip
    scores = np.full((1, 2, 16, 16), -8, np.float32)
    scores[0, 1, 8, 8] = 8
    head = save(
        folder / "head.onnx",
        [
            node("GlobalAveragePool", ["input1"], ["template"]),
            node("Mul", ["input2", "template"], ["matched"]),
            node("Conv", ["matched", "nothing"], ["faint"]),
            node("Add", ["faint", "scores"], ["output1"]),
            node("Concat", ["faint", "faint"], ["both"], axis=1),
            node("Add", ["both", "sides"], ["output2"]),
        ],
        [value("input1", FLOAT, [1, 48, 8, 8]), value("input2", FLOAT, [1, 48, 16, 16])],
        [value("output1", FLOAT, [1, 2, 16, 16]), value("output2", FLOAT, [1, 4, 16, 16])],
        {
            "scores": scores,
            "sides": np.full((1, 4, 16, 16), 32, np.float32),
            "nothing": np.zeros((2, 48, 1, 1), np.float32),
        },
    )
    return {"backbone": backbone, "head": head}


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    return float((mask & truth).sum() / (mask | truth).sum())


def test_a_moving_disc_is_followed(networks: dict[str, str]) -> None:
    clip = moving_disc((120, 160), 5)
    tracker = NanoTracker.from_options(NanoTracker.Options(**networks))
    tracker.init(clip.frames[0], clip.prompt(with_mask=False))
    for index, frame in enumerate(clip.frames[1:], 1):
        mask = tracker.step(frame).binary
        assert mask is not None
        assert iou(mask, np.roll(clip.mask, 2 * index, axis=1)) > 0.8


def test_it_conforms(networks: dict[str, str]) -> None:
    check_tracker(NanoTracker, **networks)


def test_a_correction_moves_the_tracker(networks: dict[str, str]) -> None:
    clip = moving_disc((120, 160), 3)
    tracker = NanoTracker.from_options(NanoTracker.Options(**networks))
    tracker.init(clip.frames[0], Prompt((2.0, 2.0, 20.0, 20.0)))
    tracker.correct(clip.frames[0], clip.mask)
    mask = tracker.step(clip.frames[1]).binary
    assert mask is not None
    assert iou(mask, np.roll(clip.mask, 2, axis=1)) > 0.8


def test_missing_networks_are_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path))
    with pytest.raises(InputError, match="nanotrack-backbone"):
        NanoTracker.from_options(NanoTracker.Options())


def test_a_box_outside_the_frame_is_refused(networks: dict[str, str]) -> None:
    with pytest.raises(InputError, match="inside"):
        NanoTracker.from_options(NanoTracker.Options(**networks)).init(
            moving_disc((60, 80), 1).frames[0], Prompt((200.0, 0.0, 20.0, 20.0))
        )


@pytest.mark.skipif(not (SHARED / "models").is_dir(), reason="NanoTrack's files are absent")
def test_nanotrack_follows_the_car() -> None:
    folder = SHARED / "data" / "car_shadow"
    files = {name: str(SHARED / "models" / f"nanotrack_v2_{name}.onnx") for name in ("backbone", "head")}
    tracker = NanoTracker.from_options(NanoTracker.Options(**files))
    box = tuple(float(side) for side in json.loads((folder / "init.json").read_text())["bbox_xywh"])
    for index in range(10):
        image = cv2.imread(str(folder / "frames" / f"{index:06d}.jpg"))
        frame = Frame(index, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        mask = (tracker.step(frame) if index else tracker.init(frame, Prompt(box))).binary
    assert mask is not None
    truth = cv2.imread(str(folder / "masks" / "000009.png"), cv2.IMREAD_GRAYSCALE) > 127
    assert iou(mask, truth) > 0.6
