"""Images go into networks and masks come out where the object is, whatever the description says of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_networks import SIDE, decoder, encoder, saliency_network

from tracking3d.errors import InputError
from tracking3d.trackers.onnx.description import Decoder, ImageInput, PromptableNetwork, SaliencyNetwork
from tracking3d.trackers.onnx.images import (
    Proposal,
    enlarge,
    fit_image,
    network_input,
    on_image,
    sharpness,
    sigmoid,
)
from tracking3d.trackers.onnx.judging import ColourJudge, background_points
from tracking3d.trackers.onnx.promptable import PromptableSegmenter
from tracking3d.trackers.onnx.saliency import SaliencySegmenter

BOX = (30.0, 20.0, 40.0, 25.0)


@pytest.fixture
def image() -> np.ndarray:
    """A warm rectangle, `BOX`, on blue; 90 rows, 120 columns."""
    image = np.empty((90, 120, 3), np.uint8)
    image[:] = 20, 60, 200
    image[20:45, 30:70] = 220, 90, 30
    return image


def rectangle(shape: tuple[int, int] = (90, 120)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[20:45, 30:70] = True
    return mask


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    return float(((mask > 0.5) & truth).sum() / ((mask > 0.5) | truth).sum())


def promptable(tmp_path: Path, **decoder_keys: object) -> PromptableSegmenter:
    return PromptableSegmenter(
        encoder(tmp_path / "encoder.onnx"),
        decoder(tmp_path / "decoder.onnx"),
        PromptableNetwork(
            kind="promptable",
            input=ImageInput(size=SIDE, fit="pad", divisor=1.0),
            decoder=Decoder(**{"grid": "input", **decoder_keys}),
        ),
        threads=1,
    )


def test_values_go_in_as_described():
    image = np.full((10, 20, 3), (50, 100, 200), np.uint8)
    description = ImageInput(size=(16, 32), divisor=100, mean=(0.5, 1, 1), std=(0.5, 1, 2))
    fit = fit_image((10, 20), description)
    array = network_input(image, fit, description)
    assert array.shape == (1, 3, 16, 32) and array.dtype == np.float32
    np.testing.assert_allclose(array[0, :, 7, 9], [0, 0, 0.5], atol=1e-6)
    swapped = network_input(image, fit, description.model_copy(update={"channels": "bgr", "layout": "hwc"}))
    assert swapped.shape == (16, 32, 3)
    np.testing.assert_allclose(swapped[7, 9], [0.5, 0, 0], atol=1e-6)


def test_the_largest_value_divides_where_the_description_says_so():
    image = np.full((16, 16, 3), (50, 100, 200), np.uint8)
    description = ImageInput(divisor="max")
    array = network_input(image, fit_image((16, 16), description), description)
    np.testing.assert_allclose(array[0, :, 3, 3], [0.25, 0.5, 1])


def test_padding_keeps_the_proportions_and_takes_its_colour():
    description = ImageInput(size=32, fit="pad", padding=(255, 0, 0))
    fit = fit_image((10, 20), description)
    assert (fit.content, fit.input) == ((16, 32), (32, 32))
    np.testing.assert_allclose(fit.scale, [1.6, 1.6])
    array = network_input(np.zeros((10, 20, 3), np.uint8), fit, description)
    np.testing.assert_allclose(array[0, :, 15, 31], [0, 0, 0])
    np.testing.assert_allclose(array[0, :, 16, 0], [1, 0, 0])


@pytest.mark.parametrize("padded", [True, False])
def test_a_grid_comes_back_to_the_pixels_it_covers(padded):
    fit = fit_image((40, 80), ImageInput(size=64, fit="pad"))
    grid = np.zeros((32, 32), np.float32)
    grid[4:8, 10:20] = 1  # covers 64 x 64 input pixels, of which the image has 32 rows; or the image alone
    full = on_image(grid, fit, padded)
    assert full.shape == (40, 80)
    rows, columns = np.nonzero(full > 0.5)
    height = 40 / 16 if padded else 40 / 32
    assert (columns.min(), columns.max() + 1) == (25, 50)
    np.testing.assert_allclose([rows.min(), rows.max() + 1], [4 * height, 8 * height], atol=1)


def test_a_box_is_enlarged_about_its_centre_within_the_frame():
    assert enlarge((10, 20, 20, 10), 1.5, (100, 100)) == (slice(18, 32), slice(5, 35))
    assert enlarge((-10, -10, 30, 30), 1.0, (100, 100)) == (slice(0, 20), slice(0, 20))
    for box in ((500.0, 500.0, 10.0, 10.0), (-50.0, 5.0, 10.0, 0.0)):
        rows, columns = enlarge(box, 1.2, (100, 50))
        assert rows.stop - rows.start >= 2 and columns.stop - columns.start >= 2
        assert rows.start >= 0 and columns.stop <= 50


def test_sharpness_is_the_share_of_the_area_that_no_threshold_takes_away():
    assert sharpness(np.float32([1, 1, 0, 0])) == 1
    assert sharpness(np.float32([1, 0.5, 0.5, 0])) == pytest.approx(1 / 3)
    assert sharpness(np.zeros(4, np.float32)) == 0


def test_the_sigmoid_does_not_overflow():
    np.testing.assert_allclose(sigmoid(np.float32([-1e4, 0, np.log(3), 1e4])), [0, 0.5, 0.75, 1], atol=1e-6)


@pytest.mark.parametrize("fit", ["stretch", "pad"])
@pytest.mark.parametrize(("side", "size"), [(SIDE, SIDE), ("s", None)])
def test_a_saliency_network_finds_the_warm_rectangle(tmp_path, image, fit, side, size):
    file = saliency_network(tmp_path / "network.onnx", side=side)
    description = SaliencyNetwork(kind="saliency", input=ImageInput(size=size, fit=fit))
    segmenter = SaliencySegmenter(file, description, (1.2, 1.5), threads=1)
    proposals = segmenter.propose(image, BOX, None)
    assert [proposal.origin for proposal in proposals] == [
        "crop enlarged 1.2 times",
        "crop enlarged 1.5 times",
    ]
    for proposal in proposals:
        assert proposal.mask.shape == (90, 120)
        assert iou(proposal.mask, rectangle()) > 0.9
        assert proposal.sharpness > 0.8


def test_what_stands_out_beside_the_box_is_not_the_object(tmp_path, image):
    image[50:60, 30:70] = 220, 90, 30  # as warm as the object, in the crop but beyond the box
    segmenter = SaliencySegmenter(
        saliency_network(tmp_path / "network.onnx"),
        SaliencyNetwork(kind="saliency", input=ImageInput(size=SIDE)),
        (2.5,),
        threads=1,
    )
    (proposal,) = segmenter.propose(image, BOX, None)
    assert not proposal.mask[50:60].any()


@pytest.mark.parametrize(
    ("activation", "normalise"), [("none", True), ("sigmoid", False), ("softmax", False), ("none", False)]
)
def test_outputs_of_any_range_become_shares(tmp_path, image, activation, normalise):
    file = saliency_network(tmp_path / "network.onnx", gain=4.0, activation="Identity")
    description = SaliencyNetwork(
        kind="saliency", input=ImageInput(size=SIDE), activation=activation, normalise=normalise
    )
    (proposal,) = SaliencySegmenter(file, description, (1.5,), 1).propose(image, BOX, None)
    assert proposal.mask.min() >= 0 and proposal.mask.max() <= 1
    if activation != "softmax":  # over one channel it is 1 everywhere
        assert iou(proposal.mask, rectangle()) > 0.9


def test_the_embedding_is_computed_once_for_all_prompts_of_a_frame(tmp_path, image, monkeypatch):
    segmenter = promptable(tmp_path)
    runs = {"encoder": 0, "decoder": 0}
    for name in runs:
        network = getattr(segmenter, f"_{name}")
        original = network.run

        def counted(feeds, name=name, original=original):
            runs[name] += 1
            return original(feeds)

        monkeypatch.setattr(network, "run", counted)
    segmenter.propose(image, BOX, rectangle().astype(np.float32))
    assert runs == {"encoder": 1, "decoder": 2}


def asked(segmenter: PromptableSegmenter, monkeypatch: pytest.MonkeyPatch) -> list[tuple[list, list]]:
    """Collects what the decoder is asked: points in pixels of its input, and labels."""
    prompts, original = [], segmenter._decoder.run

    def spied(feeds):
        prompts.append((feeds["point_coords"][0].tolist(), feeds["point_labels"][0].tolist()))
        return original(feeds)

    monkeypatch.setattr(segmenter._decoder, "run", spied)
    return prompts


def test_the_box_asked_for_is_the_mean_of_the_trackers_and_the_last_masks(tmp_path, monkeypatch):
    image = np.full((64, 64, 3), (220, 90, 30), np.uint8)
    segmenter = promptable(tmp_path)
    prompts = asked(segmenter, monkeypatch)
    last = np.zeros((64, 64), np.float32)
    last[20:40, 10:50] = 1.0
    segmenter.propose(image, (10.0, 20.0, 20.0, 10.0), None)
    segmenter.propose(image, (10.0, 20.0, 20.0, 10.0), last)
    assert prompts[0] == ([[20, 25], [10, 20], [30, 30]], [1, 2, 3])
    assert prompts[1] == prompts[2] == ([[25, 27.5], [10, 20], [40, 35]], [1, 2, 3])


def test_a_hole_in_the_first_answer_is_asked_about_as_beside_the_object(tmp_path, image, monkeypatch):
    image[28:37, 46:54] = 20, 60, 200
    segmenter = promptable(tmp_path)
    look = segmenter.look(image)
    filled = [Proposal(rectangle().astype(np.float32), 1.0, "box and centre")]
    answers = [filled, look.ask(BOX)]
    calls = []
    monkeypatch.setattr(
        type(look), "ask", lambda self, *given, **named: (calls.append(given), answers[len(calls) - 1])[1]
    )
    proposals = segmenter.propose(image, BOX, None)
    assert len(proposals) == 2
    (points,) = [given[1] for given in calls[1:]]
    assert points.shape == (1, 3) and points[0, 2] == 0
    assert 46 < points[0, 0] < 54 and 28 < points[0, 1] < 37


@pytest.mark.parametrize("coordinates", ["input", "image"])
def test_a_box_is_given_in_the_pixels_that_the_decoder_counts_in(tmp_path, coordinates):
    image = np.full((32, 64, 3), (220, 90, 30), np.uint8)  # all warm, and as wide as the input
    (proposal,) = promptable(tmp_path, coordinates=coordinates).look(image).ask((16.0, 8.0, 24.0, 16.0))
    rows, columns = np.nonzero(proposal.mask > 0.5)  # the small decoder grows boxes by 4 pixels
    np.testing.assert_allclose([columns.min(), columns.max() + 1], [12, 44], atol=2)
    np.testing.assert_allclose([rows.min(), rows.max() + 1], [4, 28], atol=2)


def test_coordinates_follow_the_scale_of_the_input(tmp_path, image):
    (proposal,) = promptable(tmp_path).look(image).ask(BOX)
    assert iou(proposal.mask, rectangle()) > 0.85
    (elsewhere,) = promptable(tmp_path).look(image).ask((90.0, 60.0, 20.0, 20.0))
    assert not (elsewhere.mask > 0.5).any()


def test_the_last_mask_is_told_as_logits_on_the_decoders_grid(tmp_path, image):
    grey = np.full_like(image, 128)  # nothing is warm: only the last mask speaks
    look = promptable(tmp_path).look(grey)
    (without,) = look.ask(BOX)
    (told,) = look.ask(BOX, mask=rectangle().astype(np.float32))
    assert without.mask.max() <= 0.5
    assert iou(told.mask, rectangle()) > 0.85


def test_a_name_that_the_network_does_not_have_is_told_with_those_it_has(tmp_path):
    with pytest.raises(InputError, match=r"no input 'points' \(it has .*point_coords"):
        promptable(tmp_path, points="points")
    with pytest.raises(InputError, match="no output 'logits'"):
        promptable(tmp_path, masks="logits")
    file = saliency_network(tmp_path / "network.onnx")
    for keys, told in (
        ({"output": "d0"}, "no output 'd0'"),
        ({"input": ImageInput(name="x")}, "no input 'x'"),
    ):
        with pytest.raises(InputError, match=told):
            SaliencySegmenter(file, SaliencyNetwork(kind="saliency", **keys), (1.5,), 1)


def test_an_encoder_whose_output_has_another_name_is_matched_by_the_description(tmp_path, image):
    files = encoder(tmp_path / "encoder.onnx", output="features"), decoder(tmp_path / "decoder.onnx")
    description = PromptableNetwork(
        kind="promptable", input=ImageInput(size=SIDE, fit="pad", divisor=1.0), decoder=Decoder(grid="input")
    )
    with pytest.raises(InputError, match="no output 'image_embeddings'"):
        PromptableSegmenter(*files, description, 1)
    matched = description.model_copy(update={"embeddings": {"image_embeddings": "features"}})
    assert iou(PromptableSegmenter(*files, matched, 1).look(image).ask(BOX)[0].mask, rectangle()) > 0.85


def test_an_output_without_an_image_is_one_sentence(tmp_path, image):
    with pytest.raises(InputError, match="size_again"):
        promptable(tmp_path, masks="size_again").look(image).ask(BOX)
    file = saliency_network(tmp_path / "network.onnx")
    description = SaliencyNetwork(kind="saliency", input=ImageInput(size=SIDE), channel=3)
    with pytest.raises(InputError, match="no channel 3"):
        SaliencySegmenter(file, description, (1.5,), 1).propose(image, BOX, None)


def test_an_input_of_a_wrong_size_is_one_sentence(tmp_path, image):
    file = saliency_network(tmp_path / "network.onnx")
    description = SaliencyNetwork(kind="saliency", input=ImageInput(size=32))
    with pytest.raises(InputError, match=r"network\.onnx") as error:
        SaliencySegmenter(file, description, (1.5,), 1).propose(image, BOX, None)
    assert len(str(error.value).splitlines()) == 1


def test_a_hole_is_pointed_at_and_a_side_of_another_colour_is_not(image):
    mask = rectangle()
    image[25:40, 45:55] = 20, 60, 200  # the background shows through
    image[20:45, 60:70] = 30, 180, 40  # another side of the object
    points = background_points(image, mask.astype(np.float32))
    assert len(points) == 1
    x, y = points[0]
    assert 45 < x < 55 and 25 < y < 40


def test_a_mask_without_holes_or_without_pixels_has_no_points(image):
    assert background_points(image, rectangle().astype(np.float32)).shape == (0, 2)
    assert background_points(image, np.zeros((90, 120), np.float32)).shape == (0, 2)


def test_the_score_falls_with_a_wrong_box_wrong_colours_and_a_blurred_mask(image):
    mask = rectangle().astype(np.float32)
    judge = ColourJudge(image, mask)

    def score(mask: np.ndarray, sharp: float = 1.0, box: tuple = BOX) -> float:
        return judge.verdict(image, Proposal(mask, sharp, "test"), box).score

    right = score(mask)
    assert right > 0.9
    assert score(mask, sharp=0.6) < 0.5 * right
    assert score(mask, box=(60.0, 40.0, 40.0, 25.0)) < 0.6 * right
    assert score(np.roll(mask, 25, axis=0), box=(30.0, 45.0, 40.0, 25.0)) < 0.5 * right
    assert score(np.zeros_like(mask)) < 0.1


def test_colours_sharpen_a_mask_that_is_undecided_but_do_not_overrule_a_network_that_is_sure(image):
    judge = ColourJudge(image, rectangle().astype(np.float32))
    undecided = np.where(rectangle(), 0.6, 0.0).astype(np.float32)
    undecided[50:60, 30:70] = 0.55  # cool, and a little more likely than not for the network
    sharpened = judge.verdict(image, Proposal(undecided, 1.0, "test"), BOX).proposal.mask
    assert iou(sharpened, rectangle()) > 0.95
    certain = np.where(rectangle(), 0.98, 0.0).astype(np.float32)
    certain[50:60, 30:70] = 0.98
    kept = judge.verdict(image, Proposal(certain, 1.0, "test"), BOX).proposal.mask
    assert (kept[52:58, 34:66] > 0.5).all()
    assert not sharpened[0:10].any()  # where the network saw nothing


def test_a_correction_that_shows_other_colours_makes_the_judge_begin_anew(image):
    wrong = np.zeros((90, 120), np.float32)
    wrong[60:80, 80:110] = 1.0  # a part of the background
    mask = rectangle().astype(np.float32)
    judge = ColourJudge(image, wrong)
    proposal = Proposal(mask, 1.0, "test")
    assert judge.verdict(image, proposal, BOX).score < 0.5
    anew = judge.corrected(image, mask)
    assert anew.verdict(image, proposal, BOX).score > 0.9
    assert anew.corrected(image, mask) is anew
