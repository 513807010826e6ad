"""The ostrack plug-in: networks of the projects' signatures track, and what the projects write is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_ostrack import BOXES, save, write_constant_ostrack, write_ostrack, write_refine
from tracking3d_ostrack import OsTracker
from tracking3d_ostrack.network import OsTrackBoxes
from tracking3d_ostrack.patches import Patch
from tracking3d_ostrack.refinement import AlphaRefine

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.testing import check_tracker
from tracking3d.trackers.protocol import MaskTracker
from tracking3d.trackers.vot_regions import encode_mask, format_region

BOX = (20.0, 30.0, 60.0, 60.0)


@pytest.fixture(scope="module")
def models(tmp_path_factory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("models")
    return {
        "maps": str(write_ostrack(folder / "maps.onnx")),
        "boxes": str(write_ostrack(folder / "boxes.onnx", BOXES)),
        "refinement": str(write_refine(folder / "refine.onnx")),
    }


def disc_at(x: int, index: int = 0, radius: int = 30) -> tuple[Frame, np.ndarray]:
    rows, columns = np.mgrid[:120, :220]
    mask = (rows - 60) ** 2 + (columns - x) ** 2 < radius**2
    background = np.dstack([columns // 8 % 2 * 40, rows // 8 % 2 * 40, rows * 0 + 120])
    texture = np.dstack([rows * 0 + 220, (rows + columns - x) // 6 % 2 * 90, rows * 0])
    image = np.where(mask[..., None], texture, background).astype(np.uint8)
    return Frame(index, image, name=f"frame {index}"), mask


def tracker(**options) -> OsTracker:
    return OsTracker.from_options(OsTracker.Options(**options))


def iou(answer: MaskEstimate, truth: np.ndarray) -> float:
    mask = answer.binary
    return 0.0 if mask is None else float((mask & truth).sum() / (mask | truth).sum())


@pytest.mark.parametrize("outputs", ["maps", "boxes"])
@pytest.mark.parametrize("refined", [False, True])
@pytest.mark.parametrize("with_mask", [False, True])
def test_a_moving_disc_is_followed(models, outputs, refined, with_mask):
    made = tracker(model=models[outputs], refinement=models["refinement"] if refined else None)
    assert isinstance(made, MaskTracker)
    frame, truth = disc_at(50)
    assert iou(made.init(frame, Prompt(BOX, truth if with_mask else None)), truth) > 0.85
    for index, x in enumerate(range(54, 170, 6), start=1):
        frame, truth = disc_at(x, index)
        answer = made.step(frame)
        assert iou(answer, truth) > 0.85
        assert 0.1 < answer.score <= 1


def test_an_object_that_is_gone_has_no_mask(models):
    made = tracker(model=models["maps"], refinement=models["refinement"])
    made.init(disc_at(50)[0], Prompt(BOX))
    answer = made.step(disc_at(-100, 1)[0])
    assert answer.mask is None
    assert "finds no object" in answer.reason


def test_a_corrected_tracker_goes_on_from_there(models):
    made = tracker(model=models["maps"], refinement=models["refinement"])
    made.init(disc_at(40, radius=15)[0], Prompt((25, 45, 30, 30)))
    frame, truth = disc_at(180, 1, 15)
    assert iou(made.step(frame), truth) == 0
    made.correct(frame, truth)
    assert iou(made.step(frame), truth) > 0.85


@pytest.mark.parametrize("refined", [False, True])
def test_it_keeps_to_the_protocol(models, refined):
    options = {"refinement": models["refinement"]} if refined else {}
    check_tracker(OsTracker, model=models["maps"], **options)


def test_the_best_cell_of_the_windowed_score_is_decoded(tmp_path):
    score, size, offset = np.zeros((1, 1, 16, 16)), np.zeros((1, 2, 16, 16)), np.zeros((1, 2, 16, 16))
    score[0, 0, 0, 0] = 0.9  # the window makes nothing of the corner
    score[0, 0, 6, 9] = 0.5
    size[0, :, 6, 9] = 0.25, 0.5
    offset[0, :, 6, 9] = 0.5, 0.25
    boxes = OsTrackBoxes(Network(write_constant_ostrack(tmp_path / "net.onnx", score, size, offset)))
    image = np.zeros((400, 400, 3), np.uint8)
    boxes.start(image, (150, 150, 64, 64))
    box, peak = boxes.update(image)
    # The crop of 256 pixels is as large as its side in the frame, from (54, 54) on.
    x, y = 54 + 256 * 9.5 / 16, 54 + 256 * 6.25 / 16
    assert box == pytest.approx((x - 32, y - 64, 64, 128))
    assert peak == pytest.approx(0.5)


def test_a_box_stays_in_the_frame(tmp_path):
    size = np.full((1, 2, 16, 16), 0.001)
    file = write_constant_ostrack(
        tmp_path / "net.onnx", np.ones((1, 1, 16, 16)), size, np.full((1, 2, 16, 16), -99)
    )
    boxes = OsTrackBoxes(Network(file))
    boxes.start(np.zeros((60, 80, 3), np.uint8), (30, 30, 20, 20))
    box, _ = boxes.update(np.zeros((60, 80, 3), np.uint8))
    assert box == (0, 0, 10, 10)


def test_crops_are_those_of_the_projects():
    assert Patch.square((100, 80, 40, 90), 2.0, 128) == Patch(60, 65, 120, 120, 128)
    assert Patch.stretch_to((100, 80, 40, 90), 2.0, 256) == Patch(80, 35, 80, 180, 256)


def test_a_patch_is_normalised_and_black_beyond_the_frame():
    image = np.full((50, 50, 3), (255, 128, 0), np.uint8)
    seen = Patch(-20, 10, 40, 20, 40).cut(image)[0]
    black = -np.array([0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    full = black + np.array([255, 128, 0]) / 255 / [0.229, 0.224, 0.225]
    np.testing.assert_allclose(seen[:, 20, 5], black, atol=1e-5)
    np.testing.assert_allclose(seen[:, 20, 35], full, atol=1e-5)


def test_what_is_cut_and_pasted_lies_where_it_lay():
    rng = np.random.default_rng(0)
    smooth = np.kron(rng.random((6, 8)), np.ones((12, 12))).astype(np.float32)
    patch = Patch(10, 5, 40, 60, 256)
    image = np.repeat((255 * smooth).astype(np.uint8)[..., None], 3, axis=2)
    grey = patch.cut(image)[0, 0] * 0.229 + 0.485
    pasted = patch.paste(grey, smooth.shape)
    inside = np.s_[7:63, 12:48]
    assert np.abs(pasted[inside] - smooth[inside]).mean() < 0.02
    assert (pasted[:4] == 0).all() and (pasted[:, :9] == 0).all()


def test_boxes_go_into_a_patch_and_out_again():
    patch = Patch(10, 20, 100, 50, 200)
    assert patch.box_in((35, 20, 50, 25)) == (50, 0, 100, 100)
    assert patch.box_out((50, 0, 100, 100)) == (35, 20, 50, 25)


def test_alpha_refine_is_given_what_the_project_gives_it(models, monkeypatch):
    seen = {}
    run = Network.run

    def spy(self, feeds):
        seen.update(feeds)
        return run(self, feeds)

    monkeypatch.setattr(Network, "run", spy)
    refine = AlphaRefine(Network(Path(models["refinement"])))
    image = np.zeros((200, 300, 3), np.uint8)
    refine.start(image, (100.0, 80.0, 64.0, 32.0))
    refine.mask(image, (100.0, 80.0, 64.0, 32.0))
    # The box is the middle half of the crop each way; its corner in pixels whose first centre is 0.
    np.testing.assert_allclose(seen["train_bb"], [[63.5, 63.5, 128, 128]])
    assert seen["train_imgs"].shape == seen["test_imgs"].shape == (1, 3, 256, 256)


def test_exports_of_another_signature_are_refused(models, tmp_path):
    file = save(tmp_path / "other.onnx", "g (float[1,3,8,8] x) => (float[1,3,8,8] y) { y = Neg (x) }")
    with pytest.raises(InputError, match="no input 'template'"):
        tracker(model=str(file))
    with pytest.raises(InputError, match="AlphaRefine: it has no input 'train_imgs'"):
        tracker(model=models["maps"], refinement=str(file))
    text = "g (float[1,3,8,8] template, float[1,3,8,8] search) => (float[1,3,8,8] y) { y = Add (template, search) }"
    with pytest.raises(
        InputError, match="neither the outputs score_map, size_map, offset_map nor pred_boxes"
    ):
        tracker(model=str(save(tmp_path / "third.onnx", text)))


def test_one_of_model_and_results_is_needed(tmp_path):
    for options in ({}, {"model": "a.onnx", "results": "b"}):
        with pytest.raises(InputError, match="give one of the two"):
            tracker(**options)
    with pytest.raises(InputError, match="no results of OSTrack at"):
        tracker(results=str(tmp_path / "absent.txt"))


def test_a_box_outside_the_frame_is_refused(models):
    with pytest.raises(InputError, match="lies outside frame 0"):
        tracker(model=models["maps"]).init(disc_at(50)[0], Prompt((500.0, 0.0, 20.0, 20.0)))


def test_boxes_that_ostrack_has_written_lead_the_segmentation(tmp_path):
    boxes = np.array([(20 + 4 * n, 30, 60, 60) for n in range(8)])
    np.savetxt(tmp_path / "disc.txt", boxes, delimiter="\t", fmt="%d")  # as OSTrack's running.py does
    made = tracker(results=str(tmp_path / "disc.txt"))
    frame, truth = disc_at(50)
    assert iou(made.init(frame, Prompt(BOX)), truth) > 0.85
    for n in range(1, 8):
        frame, truth = disc_at(50 + 4 * n, n)
        assert iou(made.step(frame), truth) > 0.85
    beyond = made.step(disc_at(82, 8)[0])
    assert beyond.reason == "OSTrack has no region for this frame"
    assert beyond.score <= 0.5


def test_masks_in_a_result_file_of_vot_are_the_answers(tmp_path):
    truths = [disc_at(50 + 4 * n)[1] for n in range(3)]
    empty = "m0,0,4,4,16"
    lines = ["1", *(format_region(encode_mask(mask)) for mask in truths[1:]), empty]
    (tmp_path / "disc_001.txt").write_text("\n".join(lines))
    made = tracker(results=str(tmp_path / "disc_001.txt"))
    made.init(disc_at(50)[0], Prompt(BOX, truths[0]))
    for n in (1, 2):
        np.testing.assert_array_equal(made.step(disc_at(50 + 4 * n, n)[0]).binary, truths[n])
    assert "empty mask" in made.step(disc_at(62, 3)[0]).reason


def test_a_folder_of_masks_is_read_as_precomputed_masks_are(tmp_path):
    for n in range(2):
        Image.fromarray(disc_at(50 + 4 * n)[1]).save(tmp_path / f"{n}.png")
    made = tracker(results=str(tmp_path))
    for n, answer in enumerate([made.init(disc_at(50)[0], Prompt(BOX)), made.step(disc_at(54, 1)[0])]):
        np.testing.assert_array_equal(answer.binary, disc_at(50 + 4 * n)[1])


def test_a_damaged_text_file_is_refused(tmp_path):
    (tmp_path / "disc.txt").write_text("1\t2\t3\t4\n1\t2\t3\n")
    with pytest.raises(InputError, match="line 2"):
        tracker(results=str(tmp_path / "disc.txt"))
