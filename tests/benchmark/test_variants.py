"""A variant changes what it says and nothing else, and its masks can be meant."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.results.files import read_mask, write_mask
from tracking3d.trackers.precomputed import PrecomputedMasks
from tracking3d.video.image_file import read_image
from tracking3d_bench.benchmark.fingerprint import masks_fingerprint
from tracking3d_bench.benchmark.initial_masks import masks_for
from tracking3d_bench.benchmark.job import Job
from tracking3d_bench.benchmark.variant import Variant, check_masks, degraded_iou, noise_pixels
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.datasets.truth import MaskFile


def test_a_changed_setting_is_the_only_change():
    base = Variant(label="base", config=load_config(preset="paper"))
    changed = base.with_changes("no motion", solver__weights__motion=0.0, masks="degraded:0.7")
    expected = load_config(preset="paper", overrides=["solver.weights.motion=0"])
    assert (changed.label, changed.masks, changed.config) == ("no motion", "degraded:0.7", expected)
    assert base.config == load_config(preset="paper")


@pytest.mark.parametrize(
    "masks",
    [
        "degraded:",
        "degraded:1.2",
        "degraded:0.1",
        "degraded:nan",
        "noise:",
        "noise:0",
        "noise:nan",
        "noise:99",
        "hands",
        "nowhere",
    ],
)
def test_masks_that_cannot_be_meant_are_refused(masks):
    with pytest.raises(InputError, match=f"The masks '{masks}'"):
        check_masks(masks)


def test_masks_that_can_be_meant_are_not(tmp_path):
    for masks in ("tracker", "truth", "initial", "degraded:0.73", "noise:1.5", "hand", str(tmp_path)):
        check_masks(masks)
    assert degraded_iou("degraded:0.73") == 0.73 and noise_pixels("noise:1.5") == 1.5


def test_rough_masks_are_made_for_a_clip_and_the_first_one_is_true(clips, tmp_path):
    truth = read_truth(clips / "narrow")
    for source in ("noise:3", "hand"):
        folder = masks_for(source, truth, tmp_path / source)
        masks = [read_mask(folder / f"{name}.png") for name in truth.names]
        assert (masks[0] == truth.masks[0].read()).all()
    noisy = read_mask(tmp_path / "noise:3" / f"{truth.names[2]}.png")
    assert (noisy != truth.masks[2].read()).any()
    assert masks_fingerprint("hand", "narrow") == masks_fingerprint("noise:3", "narrow")


def test_what_true_masks_have_hidden_is_an_occluder_of_the_tracker(clips, tmp_path):
    truth = read_truth(clips / "narrow")
    whole = truth.masks[1].read()
    visible = whole & (np.arange(whole.shape[1]) < np.flatnonzero(whole.any(0)).mean())
    write_mask(tmp_path / "visible.png", visible)
    truth = replace(truth, visible_masks={0: truth.masks[0], 1: MaskFile(tmp_path / "visible.png")})
    folder = masks_for("truth", truth, tmp_path / "masks")
    tracker = PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(folder)))
    first, second = (Frame(n, read_image(path), name=path.name) for n, path in enumerate(truth.frames[:2]))
    assert tracker.init(first, Prompt((0.0, 0.0, 1.0, 1.0))).occluder is None
    estimate = tracker.step(second)
    np.testing.assert_array_equal(estimate.binary, visible)
    np.testing.assert_array_equal(estimate.occluder, whole & ~visible)


def test_a_camera_that_is_not_told_is_not_in_the_configuration(clips, scripted, tmp_path):
    def config(clip):
        variant = scripted().with_changes("unsaid", camera__fov=None)
        return Job("clip", clips, clip, variant, tmp_path / "out").config.camera.intrinsics

    assert config("narrow") is not None
    file = clips / "narrow" / "camera.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"given": False}))
    assert config("narrow") is None and read_truth(clips / "narrow").camera is not None
