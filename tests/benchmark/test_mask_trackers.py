"""Mask trackers by themselves: what is measured, against hand-made cases and brute force."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError
from tracking3d_bench.benchmark.mask_table import format_masks, report
from tracking3d_bench.benchmark.mask_trackers import (
    FLOW_CUES,
    Contestant,
    TrackedFrame,
    TrackerMeasurement,
    ablation,
    area_under_roc,
    measure_trackers,
    overall,
)
from tracking3d_bench.benchmark.sequences import open_dataset
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.evaluation.metrics import mask_iou

FLOW = "tracking3d.trackers:flow=tracking3d.trackers.flow:FlowTracker"


@pytest.fixture
def dataset(clips):
    return open_dataset("real", clips, clips / "out", 1)


@pytest.fixture
def contestant(scripted):
    """Make the scripted tracker, which answers every frame with the first frame's box, a contestant."""
    scripted()

    def make(**options) -> Contestant:
        return Contestant.of(PluginChoice(name="scripted", **options))

    return make


@pytest.fixture
def flow(monkeypatch):
    monkeypatch.setenv("TRACKING3D_PLUGINS", FLOW)
    return Contestant.of(PluginChoice(name="flow"))


def brute_force_area(scores, right) -> float:
    wins = [
        0.5 * (a >= b) + 0.5 * (a > b)
        for a, is_right in zip(scores, right, strict=True)
        for b, other in zip(scores, right, strict=True)
        if is_right and not other
    ]
    return sum(wins) / len(wins)


def test_the_area_is_one_for_scores_that_tell_and_a_half_for_scores_that_do_not():
    right = [True, True, False, False]
    assert area_under_roc([0.9, 0.8, 0.3, 0.1], right) == 1
    assert area_under_roc([0.1, 0.3, 0.8, 0.9], right) == 0
    assert area_under_roc([0.5] * 4, right) == 0.5
    assert area_under_roc([0.9, 0.2, 0.3, 0.1], right) == 0.75


def test_the_area_is_the_share_of_pairs_in_the_right_order():
    rng = np.random.default_rng(0)
    for _ in range(20):
        scores, right = rng.integers(0, 6, 30) / 6, rng.random(30) < 0.4
        assert area_under_roc(scores, right) == pytest.approx(brute_force_area(scores, right))


@pytest.mark.parametrize("right", [[], [True, True], [False]])
def test_there_is_no_area_without_both_right_and_wrong(right):
    assert area_under_roc([0.5] * len(right), right) is None


def test_the_figures_of_a_few_frames():
    frames = [(0.9, 0.8, 0.9), (0.6, np.nan, 0.5), (0.4, 0.2, 0.7), (0.5, 0.5, 0.1)]
    tracked = tuple(TrackedFrame(n, *values) for n, values in enumerate(frames, start=1))
    figures = TrackerMeasurement("t", "s", tracked, seconds=(0.01, 0.5, 0.03)).figures()
    assert figures == {
        "iou_mean": pytest.approx(0.6),
        "boundary_f_mean": pytest.approx(0.5),
        "share_under_half": 0.25,
        "milliseconds": pytest.approx(30),
        "auc_50": pytest.approx(1 / 3),
        "auc_70": 1.0,
        "frames_scored": 4,
    }


def test_nothing_measured_is_nothing():
    assert set(TrackerMeasurement("t", "s", error="it failed").figures().values()) == {None, 0}


def test_masks_are_compared_with_the_truth_after_the_first_frame(contestant, dataset, clips):
    results = measure_trackers([contestant()], dataset)
    assert [(one.sequence, one.error) for one in results] == [("narrow", ""), ("wide", "")]
    for one in results:
        truth = read_truth(clips / one.sequence)
        x, y, width, height = (round(side) for side in truth.box)
        box = np.zeros_like(truth.masks[0].read())
        box[y : y + height, x : x + width] = True
        expected = [mask_iou(box, truth.masks[n].read()) for n in (1, 2)]
        assert [frame.iou for frame in one.frames] == pytest.approx(expected)
        assert [frame.index for frame in one.frames] == [1, 2] and len(one.seconds) == 2


def test_only_the_first_frames_count_where_that_is_asked_for(contestant, dataset):
    results = measure_trackers([contestant()], dataset, most_frames=2)
    assert [len(one.frames) for one in results] == [1, 1]


def test_the_visible_part_is_the_truth_where_it_is_known(contestant, dataset, clips):
    plain = measure_trackers([contestant()], dataset)[0]
    visible = clips / "narrow" / "visible_masks"
    visible.mkdir()
    for mask in (clips / "narrow" / "masks").iterdir():
        (visible / mask.name).write_bytes(mask.read_bytes())
    assert measure_trackers([contestant()], dataset)[0].frames == plain.frames
    for file in visible.iterdir():
        Image.fromarray(np.zeros((48, 64), np.uint8)).save(file)
    assert [frame.iou for frame in measure_trackers([contestant()], dataset)[0].frames] == [0, 0]


def test_a_tracker_that_fails_is_a_row_with_the_reason(contestant, dataset):
    told = []
    results = measure_trackers([contestant(fail=70), contestant()], dataset, listener=told.append)
    assert told == results
    assert [bool(one.error) for one in results] == [False, True, False, False]
    assert "this tracker fails" in results[1].error
    means = overall(results)
    assert list(means) == ["scripted fail=70", "scripted"]
    assert means["scripted fail=70"]["iou_mean"] == pytest.approx(results[0].figures()["iou_mean"])
    table = format_masks(results, dataset)
    assert table.row_count == 6 and "this tracker fails" in list(table.columns[-1].cells)[1]


def test_a_sequence_without_a_readable_frame_is_a_row_with_the_reason(contestant, dataset, clips):
    sorted((clips / "narrow" / "frames").iterdir())[1].write_bytes(b"no image")
    narrow, wide = measure_trackers([contestant()], dataset)
    assert "000001" in narrow.error and not narrow.frames and not wide.error


def test_a_sequence_without_later_truth_is_a_row_with_the_reason(contestant, dataset, clips):
    for mask in sorted((clips / "narrow" / "masks").iterdir())[1:]:
        mask.unlink()
    narrow, wide = measure_trackers([contestant()], dataset)
    assert narrow.error == "No frame after the first has a true mask or box." and not wide.error


def test_a_sequence_without_a_box_is_a_row_with_the_reason(contestant, dataset, clips):
    (clips / "narrow" / "init.json").unlink(missing_ok=True)
    (clips / "narrow" / "masks" / "000000.png").unlink()
    narrow, wide = measure_trackers([contestant()], dataset)
    assert "no box in its first frame" in narrow.error and not wide.error


def test_a_start_from_the_mask_needs_one(contestant, dataset, clips):
    from_mask = measure_trackers([contestant()], dataset, start="mask")
    assert [one.error for one in from_mask] == ["", ""]
    (clips / "narrow" / "masks" / "000000.png").unlink()
    narrow, wide = measure_trackers([contestant()], dataset, start="mask")
    assert "--start box" in narrow.error and not wide.error


def test_means_count_sequences_once_and_areas_count_frames():
    right, wrong = TrackedFrame(1, 1.0, 1.0, 0.9), TrackedFrame(1, 0.0, 0.0, 0.2)
    results = [
        TrackerMeasurement("t", "a", (right,), (0.1,)),
        TrackerMeasurement("t", "b", (wrong, wrong, wrong), (0.3,) * 3),
        TrackerMeasurement("t", "c", error="no"),
    ]
    mean = overall(results)["t"]
    assert (mean["iou_mean"], mean["share_under_half"]) == (0.5, 0.5)
    assert (mean["auc_50"], mean["frames_scored"]) == (1.0, 4)
    assert mean["milliseconds"] == pytest.approx(300)


def test_the_report_is_plain_data(contestant, dataset):
    document = report(measure_trackers([contestant()], dataset), dataset, "box")
    assert document["mean"]["scripted"]["frames_scored"] == 4
    assert document["results"][0]["frames"][0]["index"] == 1
    assert json.loads(json.dumps(document)) == document


def test_an_ablation_switches_each_cue_off_in_turn(flow):
    variants = ablation(flow)
    assert [one.label for one in variants] == [
        "flow",
        *(f"flow, {label}" for label in FLOW_CUES if label != "no witness"),
    ]
    for one in variants[1:]:
        assert len(one.choice.options) == 1
    with_witness = Contestant.of(PluginChoice(name="flow", witness="kcf", prior=0))
    labels = [one.label for one in ablation(with_witness)]
    assert "flow witness=kcf prior=0, no witness" in labels
    assert not any("no prior" in label for label in labels)


def test_only_flow_has_cues_to_switch_off(contestant):
    with pytest.raises(InputError, match="--tracker flow"):
        ablation(contestant())
