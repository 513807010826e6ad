"""The sam2 plug-in with a stand-in of the package: warm is the object, and the memory is what was seen before."""

from __future__ import annotations

import sys
import types
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import tracking3d_sam2
from tracking3d_sam2 import Sam2Tracker

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, Prompt
from tracking3d.testing import check_tracker
from tracking3d.testing.trackers import moving_disc

MEAN, DEVIATION = np.float32([0.485, 0.456, 0.406]), np.float32([0.229, 0.224, 0.225])


class StandInPredictor:
    """The part of ``SAM2VideoPredictor`` that is used: the frame's warm pixels, once there was a prompt."""

    image_size = 64

    def init_state(self, folder: str) -> dict:
        files = sorted(Path(folder).iterdir())
        height, width = cv2.imread(str(files[0])).shape[:2]
        outputs = {0: {"cond_frame_outputs": {}, "non_cond_frame_outputs": {}}}
        state = {"images": None, "num_frames": len(files), "size": (height, width), "cached_features": {0: 1}}
        return state | {"output_dict_per_obj": outputs, "prompts": []}

    def add_new_points_or_box(self, state, frame, number, box):
        state["prompts"].append((frame, "box", box))
        return self._prompted(state, frame, number)

    def add_new_mask(self, state, frame, number, mask):
        state["prompts"].append((frame, "mask", mask))
        return self._prompted(state, frame, number)

    def propagate_in_video(self, state, start, most):
        assert state["prompts"], "nothing was prompted"
        for frame in range(start, min(start + most, state["num_frames"] - 1) + 1):
            outputs = state["output_dict_per_obj"][0]
            if frame not in outputs["cond_frame_outputs"]:
                outputs["non_cond_frame_outputs"][frame] = {}
            yield frame, [1], self._logits(state, frame)

    def _prompted(self, state, frame, number):
        kind = "non_cond_frame_outputs" if frame in self._seen(state) else "cond_frame_outputs"
        state["output_dict_per_obj"][0][kind][frame] = {}
        return frame, [number], self._logits(state, frame)

    def _seen(self, state):
        return state["output_dict_per_obj"][0]["non_cond_frame_outputs"]

    def _logits(self, state, frame):
        view = state["images"][frame]
        assert view.shape == (3, self.image_size, self.image_size)
        rgb = view.numpy().transpose(1, 2, 0) * DEVIATION + MEAN
        warm = cv2.resize(20 * (rgb[..., 0] - rgb[..., 2]) - 4, state["size"][::-1])
        return torch.from_numpy(warm.astype(np.float32))[None, None]


@pytest.fixture
def package(monkeypatch) -> list[tuple]:
    """A package ``sam2``; gives what its predictors were built from."""
    built: list[tuple] = []

    def build_sam2_video_predictor(config, checkpoint, device):
        built.append((config, checkpoint, device))
        if "missing" in config:
            raise RuntimeError("Cannot find primary config 'missing'")
        return StandInPredictor()

    module = types.ModuleType("sam2.build_sam")
    module.build_sam2_video_predictor = build_sam2_video_predictor
    monkeypatch.setitem(sys.modules, "sam2", types.ModuleType("sam2"))
    monkeypatch.setitem(sys.modules, "sam2.build_sam", module)
    monkeypatch.setattr(tracking3d_sam2, "find_spec", lambda name: object())
    return built


@pytest.fixture
def weights(tmp_path) -> str:
    (tmp_path / "weights.pt").write_bytes(b"")
    return str(tmp_path / "weights.pt")


def build(weights: str, **options: object) -> Sam2Tracker:
    return Sam2Tracker.from_options(Sam2Tracker.Options(checkpoint=weights, **options))


def test_it_conforms(package, weights):
    check_tracker(Sam2Tracker, sizes=((90, 120),), frames=3, checkpoint=weights)


@pytest.mark.parametrize("with_mask", [False, True])
def test_an_object_is_followed_frame_by_frame(package, weights, with_mask):
    clip = moving_disc((90, 120), 12)
    tracker = build(weights, device="cpu")
    prompt = clip.prompt(with_mask)
    estimates = [tracker.init(clip.frames[0], prompt), *(tracker.step(frame) for frame in clip.frames[1:])]
    for index, estimate in enumerate(estimates):
        truth = np.roll(clip.mask, 2 * index, axis=1)  # it drifts by two pixels a frame
        common = np.count_nonzero(estimate.binary & truth)
        assert common / np.count_nonzero(estimate.binary | truth) > 0.8
        assert 0.5 < estimate.score <= 1
    [(frame, kind, value)] = tracker._predictor._state["prompts"]
    assert (frame, kind) == (0, "mask" if with_mask else "box")
    if not with_mask:
        x, y, width, height = clip.box
        assert value.tolist() == [x, y, x + width, y + height]


def test_what_is_remembered_is_bounded_and_the_prompt_stays(package, weights):
    tracker = build(weights, memory=16)
    image = np.full((60, 80, 3), (255, 60, 0), np.uint8)
    tracker.init(Frame(0, image), Prompt((20.0, 20.0, 20.0, 20.0)))
    for index in range(1, 40):
        tracker.step(Frame(index, image))
    outputs = tracker._predictor._state["output_dict_per_obj"][0]
    assert list(outputs["cond_frame_outputs"]) == [0]
    assert list(outputs["non_cond_frame_outputs"]) == list(range(23, 40))
    assert list(tracker._predictor._state["images"]) == [39]


def test_a_correction_enters_the_memory_at_the_last_frame(package, weights):
    tracker = build(weights)
    image = np.full((60, 80, 3), (255, 60, 0), np.uint8)
    tracker.init(Frame(0, image), Prompt((20.0, 20.0, 20.0, 20.0)))
    tracker.step(Frame(1, image))
    better = np.zeros((60, 80), bool)
    tracker.correct(Frame(1, image), better)
    assert len(tracker._predictor._state["prompts"]) == 1, "an empty mask says nothing"
    better[10:30, 10:40] = True
    tracker.correct(Frame(1, image), better)
    frame, kind, value = tracker._predictor._state["prompts"][-1]
    assert (frame, kind) == (1, "mask")
    assert np.array_equal(value, better)


def test_an_object_out_of_sight_has_no_mask(package, weights):
    tracker = build(weights)
    tracker.init(Frame(0, np.full((60, 80, 3), (255, 60, 0), np.uint8)), Prompt((20.0, 20.0, 20.0, 20.0)))
    estimate = tracker.step(Frame(1, np.zeros((60, 80, 3), np.uint8)))
    assert (estimate.mask, estimate.score, estimate.reason) == (None, 0.0, "the object is not visible")


def test_weights_that_are_missing_or_do_not_fit_are_named(package, weights):
    with pytest.raises(InputError, match=r"nowhere\.pt do not exist; download a checkpoint"):
        build("nowhere.pt")
    with pytest.raises(
        InputError, match=r"weights\.pt cannot be used with the configuration missing \(Cannot find"
    ):
        build(weights, config="missing")


def test_without_the_package_it_says_what_to_install(weights, monkeypatch):
    monkeypatch.setattr(tracking3d_sam2, "find_spec", lambda name: None)
    with pytest.raises(PluginError, match="pip install sam2"):
        build(weights)


def test_a_box_outside_and_a_frame_before_the_start_are_refused(package, weights):
    tracker = build(weights)
    image = np.zeros((60, 80, 3), np.uint8)
    with pytest.raises(PluginError, match="before it was started"):
        tracker.step(Frame(0, image))
    with pytest.raises(InputError, match="lies outside"):
        tracker.init(Frame(0, image), Prompt((200.0, 20.0, 20.0, 20.0)))
