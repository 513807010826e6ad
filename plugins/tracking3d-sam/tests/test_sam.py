"""The sam plug-in with networks of MobileSAM's signature but a few numbers, and with MobileSAM where it is."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tracking3d_sam import SamTracker

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.testing import check_tracker
from tracking3d.testing.trackers import moving_disc

onnx = pytest.importorskip("onnx")
node, value, FLOAT = onnx.helper.make_node, onnx.helper.make_tensor_value_info, onnx.TensorProto.FLOAT
SHARED = Path(__file__).resolve().parents[4] / "shared"


def save(file: Path, nodes: list, inputs: list, outputs: list, constants: dict) -> str:
    weights = [onnx.numpy_helper.from_array(np.asarray(array), name) for name, array in constants.items()]
    graph = onnx.helper.make_graph(nodes, "small", inputs, outputs, weights)
    opsets = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8), str(file))
    return str(file)


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Warm is the object: the embedding is red minus blue, the decoder brings it back to the frame."""
    folder = tmp_path_factory.mktemp("networks")
    encoder = save(
        folder / "encoder.onnx",
        [
            node("AveragePool", ["image"], ["blocks"], kernel_shape=[16, 16], strides=[16, 16]),
            node("Conv", ["blocks", "warm"], ["image_embeddings"]),
        ],
        [value("image", FLOAT, [1, 3, 1024, 1024])],
        [value("image_embeddings", FLOAT, [1, 256, 64, 64])],
        {"warm": np.tile(np.float32([0.04, 0, -0.04]).reshape(1, 3, 1, 1), (256, 1, 1, 1))},
    )
    whole = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
    decoder = save(
        folder / "decoder.onnx",
        [
            node("ReduceMean", ["image_embeddings"], ["logits"], axes=[1]),
            node("Resize", ["logits", "", "", "input_size"], ["large"], **whole),
            node("ReduceMax", ["orig_im_size"], ["longest"]),
            node("Div", ["side", "longest"], ["scale"]),
            node("Mul", ["orig_im_size", "scale"], ["content"]),
            node("Round", ["content"], ["rounded"]),
            node("Cast", ["rounded"], ["ends"], to=onnx.TensorProto.INT64),
            node("Slice", ["large", "starts", "ends", "axes"], ["cut"]),
            node("Cast", ["orig_im_size"], ["size"], to=onnx.TensorProto.INT64),
            node("Concat", ["batch", "size"], ["sizes"], axis=0),
            node("Resize", ["cut", "", "", "sizes"], ["masks"], **whole),
            *(
                node("Identity", [name], [f"{name}_again"])
                for name in ("point_coords", "point_labels", "mask_input", "has_mask_input")
            ),
        ],
        [
            value("image_embeddings", FLOAT, [1, 256, 64, 64]),
            value("point_coords", FLOAT, [1, "n", 2]),
            value("point_labels", FLOAT, [1, "n"]),
            value("mask_input", FLOAT, [1, 1, 256, 256]),
            value("has_mask_input", FLOAT, [1]),
            value("orig_im_size", FLOAT, [2]),
        ],
        [
            value("masks", FLOAT, [1, 1, "h", "w"]),
            value("point_coords_again", FLOAT, [1, "n", 2]),
            value("point_labels_again", FLOAT, [1, "n"]),
            value("mask_input_again", FLOAT, [1, 1, 256, 256]),
            value("has_mask_input_again", FLOAT, [1]),
        ],
        {
            "input_size": np.int64([1, 1, 1024, 1024]),
            "side": np.float32(1024),
            "starts": np.int64([0, 0]),
            "axes": np.int64([2, 3]),
            "batch": np.int64([1, 1]),
        },
    )
    return {"encoder": encoder, "decoder": decoder, "box": "csrt"}


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    return float((mask & truth).sum() / (mask | truth).sum())


@pytest.mark.parametrize("every", [1, 3])
def test_a_moving_disc_is_followed(networks: dict[str, str], every: int) -> None:
    clip = moving_disc((120, 160), 5)
    tracker = SamTracker.from_options(SamTracker.Options(**networks, every=every))
    tracker.init(clip.frames[0], clip.prompt(with_mask=False))
    for index, frame in enumerate(clip.frames[1:], 1):
        mask = tracker.step(frame).binary
        assert mask is not None
        assert iou(mask, np.roll(clip.mask, 2 * index, axis=1)) > 0.85


@pytest.mark.slow
def test_it_conforms(networks: dict[str, str]) -> None:
    check_tracker(SamTracker, sizes=((90, 120),), frames=2, **networks)


def test_missing_networks_are_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path))
    with pytest.raises(InputError, match=r"tracker\.encoder"):
        SamTracker.from_options(SamTracker.Options())


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "models").is_dir(), reason="MobileSAM's files are absent")
def test_mobile_sam_sees_the_car() -> None:
    folder = SHARED / "data" / "car_shadow"
    image = cv2.cvtColor(cv2.imread(str(folder / "frames" / "000000.jpg")), cv2.COLOR_BGR2RGB)
    truth = cv2.imread(str(folder / "masks" / "000000.png"), cv2.IMREAD_GRAYSCALE) > 127
    files = {name: str(SHARED / "models" / f"mobile_sam_{name}.onnx") for name in ("encoder", "decoder")}
    tracker = SamTracker.from_options(SamTracker.Options(**files, box="csrt"))
    x, y, width, height = cv2.boundingRect(truth.astype(np.uint8))
    mask = tracker.init(Frame(0, image), Prompt((float(x), float(y), float(width), float(height)))).binary
    assert mask is not None
    assert iou(mask, truth) > 0.95
