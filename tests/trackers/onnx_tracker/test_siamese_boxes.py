"""NanoTrack 3 on onnxruntime: stand-in networks score what is warm, so that the right box is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_networks import nano3_networks, nano_networks, saliency_network

from tracking3d.errors import InputError
from tracking3d.testing import check_tracker
from tracking3d.trackers.crops import box_iou
from tracking3d.trackers.onnx.boxes import NetworkBoxes, SiameseBoxes, nano_boxes
from tracking3d.trackers.onnx.tracker import OnnxTracker

SIDE = 48


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("nano3")
    return nano3_networks(folder / "backbone.onnx", folder / "head.onnx")


def frame(x: float, y: float) -> np.ndarray:
    """A warm square of `SIDE` pixels whose left upper corner is at (x, y), on grey."""
    image = np.full((240, 320, 3), 90, np.uint8)
    image[round(y) : round(y) + SIDE, round(x) : round(x) + SIDE] = (255, 120, 20)
    return image


def test_the_box_follows_what_scores_high_and_keeps_its_size(files):
    boxes = SiameseBoxes(*files)
    boxes.start(frame(60, 80), (60, 80, SIDE, SIDE))
    for step in range(1, 20):
        x, y = 60 + 7 * step, 80 + 3 * step
        found = boxes.update(frame(x, y))
        assert found is not None
        assert box_iou(found, (x, y, SIDE, SIDE)) > 0.5, step
        assert found[2:] == pytest.approx((SIDE, SIDE), abs=2)


def test_an_object_that_stands_still_keeps_its_box(files):
    boxes = SiameseBoxes(*files)
    boxes.start(frame(60, 80), (60, 80, SIDE, SIDE))
    assert boxes.update(frame(60, 80)) == pytest.approx((60, 80, SIDE, SIDE), abs=1.5)


def test_the_same_video_gives_the_same_boxes_and_a_new_start_forgets_the_old_one(files):
    first, second = SiameseBoxes(*files), SiameseBoxes(*files)
    second.start(frame(200, 20), (200, 20, SIDE, SIDE))
    second.update(frame(190, 20))
    for boxes in (first, second):
        boxes.start(frame(60, 80), (60, 80, SIDE, SIDE))
    assert [first.update(frame(60 + 5 * k, 80)) for k in range(5)] == [
        second.update(frame(60 + 5 * k, 80)) for k in range(5)
    ]


def test_without_a_start_inside_the_frame_there_is_no_box(files):
    boxes = SiameseBoxes(*files)
    assert boxes.update(frame(60, 80)) is None
    boxes.start(frame(60, 80), (-90, -90, 40, 40))
    assert boxes.update(frame(60, 80)) is None


def test_the_head_tells_the_version(files, tmp_path):
    assert isinstance(nano_boxes(*files), SiameseBoxes)
    old = nano_networks(tmp_path / "backbone.onnx", tmp_path / "head.onnx")
    assert isinstance(nano_boxes(*old), NetworkBoxes)


def test_other_networks_are_refused_with_what_to_give(files, tmp_path):
    other = saliency_network(tmp_path / "other.onnx")
    with pytest.raises(
        InputError, match=r"other\.onnx is not a network of NanoTrack 3.*its backbone and its head"
    ):
        SiameseBoxes(other, files[1])


def test_it_is_a_box_tracker_of_the_tracker_onnx(files, tmp_path):
    network = saliency_network(tmp_path / "saliency.onnx")
    description = tmp_path / "saliency.yaml"
    description.write_text("kind: saliency\ninput: {size: 64}\n", encoding="utf-8")
    backbone, head = map(str, files)
    check_tracker(
        OnnxTracker, sizes=((90, 120),), frames=3, segmenter=str(description), model=str(network),
        box="nano", nano_backbone=backbone, nano_head=head,
    )  # fmt: skip
