"""The d3s plug-in: a network of D3S' signature tracks, and what D3S writes is read as it was meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_d3s import write_small_d3s
from tracking3d_d3s import D3sTracker

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.testing import check_tracker
from tracking3d.trackers.protocol import MaskTracker
from tracking3d.trackers.segmentation import ColourSegmentation

BOX = (20.0, 30.0, 60.0, 60.0)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    return write_small_d3s(tmp_path_factory.mktemp("model") / "d3s.onnx", 128)


def disc_at(x: int, index: int = 0, radius: int = 30) -> tuple[Frame, np.ndarray]:
    rows, columns = np.mgrid[:120, :220]
    mask = (rows - 60) ** 2 + (columns - x) ** 2 < radius**2
    background = np.dstack([columns // 8 % 2 * 40, rows // 8 % 2 * 40, rows * 0 + 120])
    texture = np.dstack([rows * 0 + 220, (rows + columns - x) // 6 % 2 * 90, rows * 0])
    image = np.where(mask[..., None], texture, background).astype(np.uint8)
    return Frame(index, image, name=f"frame {index}"), mask


def tracker(**options) -> D3sTracker:
    return D3sTracker.from_options(D3sTracker.Options(**options))


def iou(answer: MaskEstimate, truth: np.ndarray) -> float:
    mask = answer.binary
    return 0.0 if mask is None else float((mask & truth).sum() / (mask | truth).sum())


@pytest.mark.parametrize("position", ["filter", "mask"])
@pytest.mark.parametrize("with_mask", [False, True])
def test_a_moving_disc_is_followed(model, position, with_mask):
    d3s = tracker(model=str(model), position=position)
    assert isinstance(d3s, MaskTracker)
    frame, truth = disc_at(50)
    first = d3s.init(frame, Prompt(BOX, truth if with_mask else None))
    assert iou(first, truth) > (0.99 if with_mask else 0.85)
    for index, x in enumerate(range(54, 170, 6), start=1):
        frame, truth = disc_at(x, index)
        answer = d3s.step(frame)
        assert iou(answer, truth) > 0.85
        assert 0.5 < answer.score <= 1


def test_an_object_that_comes_nearer_is_followed(model):
    d3s = tracker(model=str(model))
    d3s.init(disc_at(110, 0, 12)[0], Prompt((98, 48, 24, 24)))
    for index, radius in enumerate(range(13, 56), start=1):  # in the end larger than the first crop
        frame, truth = disc_at(110, index, radius)
        assert iou(d3s.step(frame), truth) > 0.8


def test_an_object_that_is_gone_has_no_mask(model):
    d3s = tracker(model=str(model), position="mask")
    d3s.init(disc_at(50)[0], Prompt(BOX))
    answer = d3s.step(disc_at(-100, 1)[0])
    assert answer.mask is None
    assert "finds no object" in answer.reason


def test_a_corrected_tracker_goes_on_from_there(model):
    d3s = tracker(model=str(model), position="mask")
    frame, truth = disc_at(50)
    d3s.init(frame, Prompt(BOX, truth))
    frame, truth = disc_at(185, 1)
    lost = d3s.step(frame)
    assert iou(lost, truth) < 0.9
    d3s.correct(frame, truth)
    assert iou(d3s.step(frame), truth) > 0.85


def test_the_network_is_given_what_the_project_gives_it(model, monkeypatch):
    seen = {}
    run = Network.run

    def spy(self, feeds):
        seen.update(feeds)
        return run(self, feeds)

    monkeypatch.setattr(Network, "run", spy)
    image = np.full((120, 220, 3), (255, 0, 128), np.uint8)
    tracker(model=str(model)).init(Frame(0, image), Prompt((80.0, 40.0, 40.0, 40.0)))
    assert {name: value.shape[1] for name, value in seen.items()} == {
        "train_imgs": 3,
        "test_imgs": 3,
        "train_masks": 1,
        "test_dist": 1,
    }
    red, green, blue = seen["test_imgs"][0].mean(axis=(1, 2))
    assert red == pytest.approx((1 - 0.485) / 0.229, abs=1e-3)
    assert green == pytest.approx((0 - 0.456) / 0.224, abs=1e-3)
    assert blue == pytest.approx((128 / 255 - 0.406) / 0.225, abs=1e-3)
    # The crop is four times the box: the box is a sixteenth of it, in the middle.
    assert seen["train_masks"].mean() == pytest.approx(1 / 16, rel=0.05)
    # Pixels from the middle of the crop, whose pixels are counted from 1.
    assert seen["test_dist"][0, 0, 63, 63] == 0
    assert seen["test_dist"][0, 0, 63, 127] == 64


def test_it_keeps_to_the_protocol(model):
    check_tracker(D3sTracker, model=str(model))


def test_exports_of_another_signature_are_refused(tmp_path):
    onnx = pytest.importorskip("onnx")
    text = (
        '<ir_version: 8, opset_import: ["": 17]> g (float[1,3,8,8] x) => (float[1,3,8,8] y) { y = Neg (x) }'
    )
    onnx.save(onnx.parser.parse_model(text), str(tmp_path / "other.onnx"))
    with pytest.raises(InputError, match=r"no input 'train_imgs' \(1, 3, 384, 384\)"):
        tracker(model=str(tmp_path / "other.onnx"))


def test_one_of_model_and_results_is_needed(tmp_path):
    for options in ({}, {"model": "a.onnx", "results": "b"}):
        with pytest.raises(InputError, match="give one of the two"):
            tracker(**options)
    with pytest.raises(InputError, match="no results of D3S at"):
        tracker(results=str(tmp_path / "absent"))


def test_a_box_outside_the_frame_is_refused(model):
    with pytest.raises(InputError, match="lies outside frame 0"):
        tracker(model=str(model)).init(disc_at(50)[0], Prompt((500.0, 0.0, 20.0, 20.0)))


def write_masks(folder: Path, masks: dict[int, np.ndarray]) -> Path:
    """As D3S saves them: 0 and 1, eight digits, counted from 1."""
    folder.mkdir()
    for number, mask in masks.items():
        Image.fromarray(mask.astype(np.uint8)).save(folder / f"{number:08d}.png")
    return folder


def test_saved_masks_are_counted_from_one(tmp_path):
    truths = [disc_at(50 + 4 * n, n)[1] for n in range(4)]
    folder = write_masks(tmp_path / "disc", {2: truths[1], 3: truths[2]})
    d3s = tracker(results=str(folder))
    first = d3s.init(disc_at(50)[0], Prompt(BOX, truths[0]))
    np.testing.assert_array_equal(first.binary, truths[0])
    for n in (1, 2):
        np.testing.assert_array_equal(d3s.step(disc_at(50 + 4 * n, n)[0]).binary, truths[n])
    missing = d3s.step(disc_at(62, 3)[0])
    assert missing.mask is None
    assert "no mask for this frame" in missing.reason


def test_without_a_first_mask_the_object_in_the_box_is_taken(tmp_path):
    frame, truth = disc_at(50)
    folder = write_masks(tmp_path / "disc", {2: truth})
    assert iou(tracker(results=str(folder)).init(frame, Prompt(BOX)), truth) > 0.85


def test_empty_damaged_and_wrong_masks_are_told(tmp_path):
    folder = write_masks(
        tmp_path / "disc",
        {1: disc_at(50)[1], 2: np.zeros((120, 220), bool), 4: np.ones((60, 110), bool)},
    )
    (folder / "00000003.png").write_bytes(b"rubbish")
    d3s = tracker(results=str(folder))
    d3s.init(disc_at(50)[0], Prompt(BOX))
    assert "empty" in d3s.step(disc_at(50, 1)[0]).reason
    assert "cannot be read" in d3s.step(disc_at(50, 2)[0]).reason
    with pytest.raises(InputError, match="110x60 pixels but frame 3 is 220x120"):
        d3s.step(disc_at(50, 3)[0])


def test_masks_that_d3s_has_not_named_are_refused(tmp_path):
    folder = write_masks(tmp_path / "disc", {0: disc_at(50)[1]})
    with pytest.raises(InputError, match="no number from 1"):
        tracker(results=str(folder))


@pytest.mark.parametrize("kind", ["boxes", "polygons"])
def test_a_text_file_of_regions_leads_the_segmentation(tmp_path, kind):
    lines = []
    for n in range(8):
        x = 50 + 4 * n
        if kind == "boxes":  # D3S counts their pixels from 1
            lines.append(f"{x - 29:f},{31:f},{60:f},{60:f}")
        else:
            lines.append(",".join(f"{v:f}" for v in (x - 30, 30, x + 30, 30, x + 30, 90, x - 30, 90)))
    file = tmp_path / "disc.txt"
    file.write_text("\n".join(lines) + "\n")
    d3s = tracker(results=str(file))
    d3s.init(disc_at(50)[0], Prompt(BOX))
    for n in range(1, 8):
        frame, truth = disc_at(50 + 4 * n, n)
        assert iou(d3s.step(frame), truth) > 0.85


def test_pixels_of_boxes_are_counted_from_one_and_those_of_polygons_from_zero(tmp_path, monkeypatch):
    boxes = []
    step = ColourSegmentation.step

    def spy(self, image, tracked_box=None):
        boxes.append(tracked_box)
        return step(self, image, tracked_box)

    monkeypatch.setattr(ColourSegmentation, "step", spy)
    file = tmp_path / "disc.txt"
    file.write_text("21,31,60,60\n25,31,60,60\n24,30,84,30,84,90,24,90\n")
    d3s = tracker(results=str(file))
    d3s.init(disc_at(50)[0], Prompt(BOX))
    d3s.step(disc_at(54, 1)[0])
    d3s.step(disc_at(54, 2)[0])
    assert boxes == [(24, 30, 60, 60), (24, 30, 60, 60)]


def test_a_damaged_text_file_is_refused(tmp_path):
    (tmp_path / "disc.txt").write_text("1,2,3,4\n1,2,three,4\n")
    with pytest.raises(InputError, match="line 2"):
        tracker(results=str(tmp_path / "disc.txt"))
