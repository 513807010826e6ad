"""Keypoints of a network: on a small one whose scores and descriptors are known, and with the one of the package."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.estimation.online.features.sift import detect, match
from tracking3d.features.keypoint_network import NetworkDetector

onnx = pytest.importorskip("onnx")
EVERYWHERE = np.ones((70, 101), bool)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The score is the brightness, from -10 to 10; the descriptor is the brightness of 4 x 4 pixels, and 1."""
    node, value = onnx.helper.make_node, onnx.helper.make_tensor_value_info
    constants = {"twenty": [[[[20.0]]]], "ten": [[[[10.0]]]], "nothing": [[[[0.0]]]], "one": [[[[1.0]]]]}
    nodes = [
        node("Mul", ["x", "twenty"], ["bright"]),
        node("Sub", ["bright", "ten"], ["score"]),
        node("AveragePool", ["x"], ["mean"], kernel_shape=[4, 4], strides=[4, 4]),
        node("Mul", ["mean", "nothing"], ["zero"]),
        node("Add", ["zero", "one"], ["ones"]),
        node("Concat", ["mean", "ones"], ["desc"], axis=1),
    ]
    graph = onnx.helper.make_graph(
        nodes, "small",
        [value("x", onnx.TensorProto.FLOAT, [1, 1, "h", "w"])],
        [value("desc", onnx.TensorProto.FLOAT, [1, 2, "a", "b"]),
         value("score", onnx.TensorProto.FLOAT, [1, 1, "h", "w"])],
        [onnx.numpy_helper.from_array(np.array(number, np.float32), name) for name, number in constants.items()],
    )  # fmt: skip
    made = tmp_path_factory.mktemp("network") / "small.onnx"
    opsets = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8), str(made))
    return made


def detector(file: Path) -> NetworkDetector:
    return NetworkDetector.from_options(NetworkDetector.Options(model=str(file), least_score=-5))


def spots(*places: tuple[float, float]) -> np.ndarray:
    y, x = np.mgrid[:70, :101]
    image = sum(np.exp(-((x - px) ** 2 + (y - py) ** 2) / 8) for px, py in places)
    return np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)


def test_peaks_are_found_between_pixels_the_brightest_first(file):
    places = [(20.3, 30.0), (60.0, 41.6), (90.0, 12.0)]
    image = np.maximum(spots(*places[:2]), (0.8 * spots(places[2])).astype(np.uint8))
    found = detector(file).detect(image, EVERYWHERE, 10, 1.0)
    assert len(found) == 3
    assert np.abs(np.sort(found.pixel[:2, 0]) - [20.3, 60.0]).max() < 0.15
    assert np.abs(found.pixel[2] - places[2]).max() < 0.15
    assert len(detector(file).detect(image, EVERYWHERE, 2, 1.0)) == 2


def test_masks_borders_and_faint_peaks_are_left_out(file):
    image, left = spots((20, 30), (60, 41), (2, 50)), EVERYWHERE.copy()
    left[:, 50:] = False
    assert detector(file).detect(image, left, 10, 1.0).pixel.round().tolist() == [[20, 30]]
    faint = (0.24 * spots((20, 30))).astype(np.uint8)  # a score of -5.3
    assert len(detector(file).detect(faint, EVERYWHERE, 10, 1.0)) == 0
    assert len(detector(file).detect(faint, EVERYWHERE, 10, 0.25)) == 1


def test_descriptors_are_taken_between_the_middles_of_cells(file):
    """Along a ramp a descriptor is as bright as the place is."""
    image = np.tile(np.arange(101, dtype=np.uint8), (70, 1))
    image[40, 60] = 255
    found = detector(file).detect(image, EVERYWHERE, 1, 1.0)
    assert found.pixel.round().tolist() == [[60, 40]]
    padded = np.pad(image, ((0, 26), (0, 27)), "edge").astype(np.float32) / 255
    cells = padded.reshape(24, 4, 32, 4).mean((1, 3))
    middles = 4 * np.arange(32) + 1.5
    above, below = (np.interp(found.pixel[0, 0], middles, cells[row]) for row in (9, 10))
    share = (found.pixel[0, 1] - 37.5) / 4
    assert found.descriptor[0, 0] == pytest.approx((1 - share) * above + share * below, abs=1e-4)
    assert found.descriptor[0, 1] == pytest.approx(1)


def test_tiny_pictures_have_keypoints_or_none(file):
    for size in ((1, 1), (9, 3), (12, 12)):
        image = np.zeros(size, np.uint8)
        image[size[0] // 2, size[1] // 2] = 255
        assert len(detector(file).detect(image, np.ones(size, bool), 5, 1.0)) == (size == (12, 12))


def test_a_file_that_is_not_there_is_told():
    with pytest.raises(InputError, match="does not exist"):
        detector(Path("absent.onnx"))


def test_the_network_of_the_package_matches_a_picture_that_is_turned_a_little():
    own = NetworkDetector.from_options(NetworkDetector.Options())
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(220, 240)), (0, 0), 2)
    image = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    turn = cv2.getRotationMatrix2D((120, 110), 12, 1.05)
    turned, mask = cv2.warpAffine(image, turn, (240, 220)), np.zeros((220, 240), bool)
    mask[50:170, 60:180] = True
    a, b = (detect(one, mask, detector=own) for one in (image, turned))
    pairs = match(a, b)
    error = b.pixel[pairs[:, 1]] - (np.column_stack([a.pixel, np.ones(len(a))])[pairs[:, 0]] @ turn.T)
    assert len(pairs) > 60
    assert np.median(np.linalg.norm(error, axis=1)) < 1
