"""The onnx tracker: masks of known truth by small networks, what it falls back to, and how the loop is closed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnxruntime import InferenceSession
from pydantic import ValidationError
from small_networks import nano_networks, saliency_network

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Box, Frame, MaskEstimate, Prompt
from tracking3d.plugins.guard import GuardedTracker, PluginFailure
from tracking3d.testing import check_tracker
from tracking3d.testing.trackers import moving_disc
from tracking3d.trackers.crops import box_of
from tracking3d.trackers.onnx import images
from tracking3d.trackers.onnx import tracker as tracker_module
from tracking3d.trackers.onnx.boxes import NetworkBoxes
from tracking3d.trackers.onnx.tracker import OnnxTracker
from tracking3d.trackers.protocol import CorrectableTracker, MaskTracker, Options

SIZE = (120, 160)
Disc = tuple[list[Frame], np.ndarray]


@pytest.fixture(scope="module")
def disc() -> Disc:
    """Ten frames of a warm disc over a cool background, and the true masks ``(10, H, W)``."""
    clip = moving_disc(SIZE, 10)
    return list(clip.frames), np.stack([np.roll(clip.mask, 2 * index, axis=1) for index in range(10)])


@pytest.fixture(params=["saliency", "promptable"])
def options(request: pytest.FixtureRequest) -> dict[str, object]:
    """Options of either kind of network."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def nano(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """Options of NanoTrack by small networks, which shrink the box from frame to frame."""
    folder = tmp_path_factory.mktemp("nano")
    backbone, head = nano_networks(folder / "backbone.onnx", folder / "head.onnx")
    return {"box": "nano", "nano_backbone": str(backbone), "nano_head": str(head)}


class ScriptedBoxes:
    """A box tracker that answers what it is told and remembers where it was started."""

    def __init__(self, answer: Callable[[int], Box | None]) -> None:
        self.answer, self.starts, self.count = answer, [], 0

    def start(self, image: np.ndarray, box: Box) -> None:
        self.starts.append(box)

    def update(self, image: np.ndarray) -> Box | None:
        self.count += 1
        return self.answer(self.count)


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[int], Box | None]], ScriptedBoxes]:
    """Puts a scripted box tracker in place of the real one."""

    def put(answer: Callable[[int], Box | None]) -> ScriptedBoxes:
        boxes = ScriptedBoxes(answer)
        monkeypatch.setattr(tracker_module, "build_boxes", lambda options: boxes)
        return boxes

    return put


def build(options: dict[str, object], **more: object) -> OnnxTracker:
    return OnnxTracker.from_options(OnnxTracker.Options(**{**options, **more}))


def box_around(mask: np.ndarray) -> Box:
    box = box_of(mask)
    assert box is not None
    return box


def track(tracker: OnnxTracker, disc: Disc, with_mask: bool = False) -> list[MaskEstimate]:
    frames, truth = disc
    prompt = Prompt(box_around(truth[0]), truth[0] if with_mask else None)
    return [tracker.init(frames[0], prompt), *(tracker.step(frame) for frame in frames[1:])]


def ious(estimates: list[MaskEstimate], truth: np.ndarray) -> list[float]:
    return [
        0.0 if e.mask is None else float((e.binary & m).sum() / (e.binary | m).sum())
        for e, m in zip(estimates, truth, strict=True)
    ]


def test_it_is_a_correctable_mask_tracker(options):
    assert isinstance(build(options), MaskTracker)
    assert isinstance(build(options), CorrectableTracker)


@pytest.mark.parametrize("with_mask", [False, True])
def test_a_disc_is_followed_by_what_the_network_sees(options, disc, with_mask):
    estimates = track(build(options), disc, with_mask)
    assert min(ious(estimates, disc[1])) > 0.9
    assert min(estimate.score for estimate in estimates) > 0.5


def test_a_given_mask_is_the_first_answer(options, disc):
    given = disc[1][0].copy()
    given[50:60, 60:70] = False
    first = build(options).init(disc[0][0], Prompt(box_around(given), given))
    np.testing.assert_array_equal(first.binary, given)


def test_the_first_box_is_segmented_and_not_taken_as_the_mask(options, disc):
    frames, truth = disc
    first = build(options).init(frames[0], Prompt(box_around(truth[0])))
    x, y = (int(value) for value in box_around(truth[0])[:2])
    assert not first.binary[y : y + 3, x : x + 3].any()  # a corner of the box lies beside the disc
    assert ious([first], truth[:1])[0] > 0.9


def test_it_conforms(saliency):
    check_tracker(OnnxTracker, sizes=((90, 120),), frames=2, **saliency)


@pytest.mark.slow
def test_it_conforms_with_a_promptable_network(promptable):
    check_tracker(OnnxTracker, sizes=((90, 120),), frames=3, **promptable)


@pytest.mark.slow
def test_it_conforms_with_nanotrack(saliency, nano):
    check_tracker(OnnxTracker, sizes=((90, 120),), frames=3, **saliency, **nano)


def test_nanotrack_that_loses_the_size_of_the_object_is_started_anew_on_the_mask(
    promptable, nano, disc, monkeypatch
):
    starts, original = [], NetworkBoxes.start

    def counted(self, image, box):
        starts.append(box)
        original(self, image, box)

    monkeypatch.setattr(NetworkBoxes, "start", counted)
    estimates = track(build(promptable, **nano), disc)
    assert min(ious(estimates, disc[1])) > 0.6
    assert len(starts) >= 2


def test_a_confident_mask_takes_a_strayed_box_tracker_back(promptable, disc, scripted):
    x, y, width, height = box_around(disc[1][0])
    small = (x + 0.2 * width, y + 0.2 * height, 0.6 * width, 0.6 * height)  # IoU with the disc's box: 0.36
    boxes = scripted(lambda count: small)
    track(build(promptable), disc, with_mask=True)
    assert len(boxes.starts) >= 2
    assert boxes.starts[0] == (x, y, width, height)


def test_without_anchoring_the_box_tracker_is_left_alone(promptable, disc, scripted):
    x, y, width, height = box_around(disc[1][0])
    small = (x + width / 4, y + height / 4, width / 2, height / 2)
    boxes = scripted(lambda count: small)
    track(build(promptable, anchor=False), disc, with_mask=True)
    assert len(boxes.starts) == 1


def test_a_box_tracker_that_is_lost_is_found_again(options, disc, scripted):
    boxes = scripted(lambda count: None if count in (2, 3) else box_around(disc[1][count]))
    estimates = track(build(options), disc)
    assert "box tracker has lost" in estimates[2].reason
    assert estimates[2].score <= 0.5 < estimates[1].score
    assert min(ious(estimates, disc[1])) > 0.85
    assert len(boxes.starts) == 3


def test_every_third_frame_is_segmented_and_flow_carries_the_mask_between(options, disc, monkeypatch):
    tracker = build(options, every=3)
    segmented, original = [], tracker._segmenter.propose

    def counted(image, box, last):
        segmented.append(len(segmented))
        return original(image, box, last)

    monkeypatch.setattr(tracker._segmenter, "propose", counted)
    estimates = track(tracker, disc, with_mask=True)
    assert len(segmented) == 3  # frames 3, 6 and 9
    assert min(ious(estimates, disc[1])) > 0.85


def test_a_doubtful_carried_mask_is_segmented_before_its_turn(saliency, disc, scripted, monkeypatch):
    scripted(lambda count: (5.0, 5.0, 20.0, 20.0) if count == 2 else box_around(disc[1][count]))
    tracker = build(saliency, every=100)
    asked = []
    original = tracker._segmenter.propose
    monkeypatch.setattr(
        tracker._segmenter,
        "propose",
        lambda *given: (asked.append(tracker._boxes.count), original(*given))[1],
    )
    track(tracker, disc, with_mask=True)
    assert set(asked) == {2}


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (lambda mask: np.zeros_like(mask), "found no object"),
        (lambda mask: np.where(mask > 0.5, 0.6, 0.3).astype(np.float32), "blurred"),
        (lambda mask: np.roll(mask, (-40, -50), (0, 1)), "disagree"),
    ],
)
def test_a_mask_that_cannot_be_used_leaves_the_carried_one_with_a_low_score(
    saliency, disc, monkeypatch, broken, reason
):
    tracker = build(saliency)
    original = tracker._segmenter.propose

    def spoilt(image, box, last):
        if last is None:
            return original(image, box, last)
        masks = [broken(proposal.mask) for proposal in original(image, box, last)]
        return [images.Proposal(mask, images.sharpness(mask), "spoilt") for mask in masks]

    monkeypatch.setattr(tracker._segmenter, "propose", spoilt)
    estimates = track(tracker, disc)
    for estimate in estimates[1:]:
        assert reason in estimate.reason and "propagated" in estimate.reason
        assert estimate.score <= 0.5
    assert min(ious(estimates, disc[1])) > 0.8


def test_a_network_that_finds_nothing_at_first_leaves_the_colours_in_the_box(folder, disc, tmp_path):
    model = saliency_network(tmp_path / "blind.onnx", gain=0.0)
    first = build({"segmenter": str(folder / "saliency.yaml"), "model": str(model)}).init(
        disc[0][0], Prompt(box_around(disc[1][0]))
    )
    assert "segmented by colour" in first.reason
    assert first.score <= 0.5
    assert ious([first], disc[1][:1])[0] > 0.8


def test_the_ellipse_in_the_box_is_told_only_where_it_stands_for_the_object(
    saliency, folder, tmp_path, caplog
):
    image = np.full((120, 160, 3), (60, 90, 150), np.uint8)
    cv2.line(
        image, (52, 42), (98, 78), (220, 90, 30), 2
    )  # too thin for colours, and what the network looks for
    blind = saliency_network(tmp_path / "blind.onnx", gain=0.0)
    for model, said in ((saliency["model"], 0), (str(blind), 1)):
        caplog.clear()
        build({**saliency, "model": model}).init(Frame(0, image), Prompt((50.0, 40.0, 50.0, 40.0)))
        assert len(caplog.records) == said


def test_of_several_crops_the_mask_that_fits_the_colours_is_chosen(saliency, disc, monkeypatch):
    tracker = build(saliency)
    original = tracker._segmenter.propose

    def with_a_worse_one(image, box, last):
        good = original(image, box, last)
        x, y, width, height = (int(value) for value in box)
        filled = np.zeros(image.shape[:2], np.float32)
        filled[max(y, 0) : y + height, max(x, 0) : x + width] = 1.0  # agrees with the box, and is sharp
        return [images.Proposal(filled, 1.0, "box"), *good]

    monkeypatch.setattr(tracker._segmenter, "propose", with_a_worse_one)
    assert min(ious(track(tracker, disc), disc[1])) > 0.9


def test_a_correction_brings_a_wrong_start_back(options, disc):
    frames, truth = disc
    tracker = build(options)
    tracker.init(frames[0], Prompt((2.0, 2.0, 20.0, 20.0)))
    assert ious([tracker.step(frames[1])], truth[1:2])[0] < 0.3
    tracker.correct(frames[1], truth[1])
    after = [tracker.step(frame) for frame in frames[2:]]
    assert min(ious(after, truth[2:])) > 0.75


def test_an_empty_correction_changes_nothing(options, disc):
    frames, truth = disc
    plain, corrected = build(options), build(options)
    for tracker in (plain, corrected):
        tracker.init(frames[0], Prompt(box_around(truth[0])))
        tracker.step(frames[1])
    corrected.correct(frames[1], np.zeros(SIZE, bool))
    np.testing.assert_array_equal(plain.step(frames[2]).mask, corrected.step(frames[2]).mask)


def test_an_object_that_leaves_is_answered_with_a_low_score_or_no_mask(options, disc):
    gone = cv2.GaussianBlur(disc[0][0].image[:, :40], (0, 0), 3)
    empty = np.ascontiguousarray(np.tile(gone, (1, 4, 1)))
    tracker = build(options)
    track(tracker, disc)
    for index in range(3):
        estimate = tracker.step(Frame(10 + index, empty))
    assert estimate.score < 0.3
    assert estimate.reason


@pytest.mark.parametrize("box", [(300.0, 10.0, 20.0, 20.0), (-50.0, -50.0, 40.0, 40.0)])
def test_a_box_outside_the_frame_is_an_input_error(options, disc, box):
    with pytest.raises(InputError, match="outside frame 0"):
        build(options).init(disc[0][0], Prompt(box))


def test_a_frame_before_the_start_is_a_plugin_error(options, disc):
    with pytest.raises(PluginError):
        build(options).step(disc[0][0])


def test_options_are_checked(saliency):
    for wrong in ({"every": 0}, {"crops": ()}, {"crops": (0.5,)}, {"box": "kcf"}, {"thread": 2}):
        with pytest.raises(ValidationError):
            OnnxTracker.Options(**{**saliency, **wrong})
    with pytest.raises(PluginError):
        OnnxTracker.from_options(Options())
    assert all(field.description for field in OnnxTracker.Options.model_fields.values())


def test_a_network_that_is_missing_is_named_with_its_option(saliency, promptable, tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path))
    absent = str(tmp_path / "absent.onnx")
    for options, option in (
        ({**saliency, "model": absent}, "tracker.model"),
        ({**promptable, "encoder": absent}, "tracker.encoder"),
        ({**promptable, "decoder": absent}, "tracker.decoder"),
        ({**saliency, "box": "nano", "nano_backbone": absent}, "tracker.nano_backbone"),
        ({**saliency, "box": "vit", "vit_model": absent}, "tracker.vit_model"),
        ({**saliency, "model": None}, "tracker.model"),
        ({"segmenter": "u2netp"}, "tracker.model"),
        ({"segmenter": "mobile-sam"}, "tracker.encoder"),
    ):
        with pytest.raises(InputError, match=option) as told:
            build(options)
        assert len(str(told.value).splitlines()) == 1


def test_what_is_no_network_is_refused(saliency, tmp_path):
    text = tmp_path / "text.onnx"
    text.write_text("not a network")
    for wrong in (
        {"model": str(text)},
        {"box": "nano", "nano_backbone": str(text), "nano_head": str(text)},
        {"box": "vit", "vit_model": str(text)},
    ):
        with pytest.raises(InputError, match=r"text\.onnx"):
            build({**saliency, **wrong})


def test_a_network_that_answers_with_no_numbers_is_refused_when_it_is_made(saliency, tmp_path):
    model = saliency_network(tmp_path / "odd.onnx", gain=float("nan"))
    with pytest.raises(InputError, match=r"'salient' of .*odd\.onnx is not a number"):
        build({**saliency, "model": str(model)})
    description = tmp_path / "zero.yaml"
    description.write_text("kind: saliency\ninput: {size: 64, divisor: 0}\n")
    with pytest.raises(InputError, match=r"zero\.yaml.*divisor"):
        build({**saliency, "segmenter": str(description)})


def test_a_box_network_that_cannot_track_is_refused_when_it_is_made(saliency, nano, tmp_path):
    wrong = saliency["model"]
    for options, told in (
        ({"box": "vit", "vit_model": wrong}, "TrackerVit cannot track by"),
        (
            {**nano, "nano_backbone": nano["nano_head"], "nano_head": nano["nano_backbone"]},
            "TrackerNano cannot",
        ),
    ):
        with pytest.raises(InputError, match=told):
            build({**saliency, **options})


def test_numbers_that_become_none_in_a_later_frame_are_the_reason_of_that_frame(saliency, disc, monkeypatch):
    tracker = GuardedTracker(build(saliency), "tracker 'onnx'")
    tracker.init(disc[0][0], Prompt(box_around(disc[1][0])))
    run = InferenceSession.run
    monkeypatch.setattr(InferenceSession, "run", lambda *given: [np.nan * out for out in run(*given)])
    with pytest.raises(PluginFailure, match="is not a number"):
        tracker.step(disc[0][1])


@pytest.mark.slow
def test_real_networks_reach_what_the_docs_promise_on_a_short_clip(shared_data: Path, shared_models: Path):
    pytest.importorskip("onnx")
    folder = shared_data / "car_shadow"
    tracker = build(
        {"segmenter": "u2netp", "model": str(shared_models / "u2netp.onnx"), "crops": (1.5,)},
        box="nano",
        nano_backbone=str(shared_models / "nanotrack_v2_backbone.onnx"),
        nano_head=str(shared_models / "nanotrack_v2_head.onnx"),
    )
    frames, truth = [], []
    for index in range(3):
        image = cv2.imread(str(folder / "frames" / f"{index:06d}.jpg"))
        frames.append(Frame(index, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)))
        truth.append(cv2.imread(str(folder / "masks" / f"{index:06d}.png"), cv2.IMREAD_GRAYSCALE) > 127)
    assert min(ious(track(tracker, (frames, np.stack(truth))), np.stack(truth))) > 0.96


class ScriptedSegmenter:
    """Proposes what it is told, and remembers the points that it was given."""

    def __init__(self, *masks: np.ndarray) -> None:
        self.masks, self.given = masks, []

    def propose(self, image: np.ndarray, box: Box, last: np.ndarray | None) -> list[images.Proposal]:
        return [images.Proposal(mask.astype(np.float32), 1.0, "box") for mask in self.masks]

    def propose_by_points(self, image: np.ndarray, points: np.ndarray) -> list[images.Proposal]:
        self.given.append(points)
        return [images.Proposal(mask.astype(np.float32), 1.0, "points") for mask in self.masks]


def test_a_network_that_takes_points_makes_the_first_mask_of_them(disc, saliency, monkeypatch):
    frames, truth = disc
    y, x = np.argwhere(truth[0]).mean(0)
    points = np.float32([(x, y, 1), (2, 2, 0)])
    rough = cv2.dilate(truth[0].astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    prompt = Prompt(box_of(rough), rough, points)
    beside = np.zeros_like(rough)
    beside[:10, :10] = True
    for masks, expected in (((beside, truth[0]), truth[0]), ((beside,), rough)):
        segmenter = ScriptedSegmenter(*masks)
        monkeypatch.setattr(tracker_module, "build_segmenter", lambda options, made=segmenter: made)
        answer = OnnxTracker(OnnxTracker.Options(**saliency)).init(frames[0], prompt)
        assert segmenter.given[0] is points
        assert ((answer.mask > 0.5) == expected).all()


def test_a_network_that_takes_no_points_starts_from_the_mask_that_was_made_of_them(disc, saliency):
    frames, truth = disc
    y, x = np.argwhere(truth[0]).mean(0)
    prompt = Prompt(box_of(truth[0]), truth[0], np.float32([(x, y, 1)]))
    answer = OnnxTracker(OnnxTracker.Options(**saliency)).init(frames[0], prompt)
    assert ((answer.mask > 0.5) == truth[0]).all()


def test_a_promptable_network_is_asked_with_the_points_and_then_with_their_box(disc, promptable):
    frames, truth = disc
    y, x = np.argwhere(truth[0]).mean(0)
    prompt = Prompt(box_of(truth[0]), truth[0], np.float32([(x, y, 1)]))
    answer = OnnxTracker(OnnxTracker.Options(**promptable)).init(frames[0], prompt)
    found = answer.mask > 0.5
    assert (found & truth[0]).sum() / (found | truth[0]).sum() > 0.9
