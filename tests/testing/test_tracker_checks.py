"""``check_tracker`` finds every fault that it is there for, and passes trackers that have none."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import cv2
import numpy as np
import pytest
from pydantic import BaseModel, Field

from tracking3d.errors import InputError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.plugins import TRACKERS, list_plugins, load_plugin
from tracking3d.testing import check_tracker
from tracking3d.testing.trackers import moving_disc
from tracking3d.trackers.precomputed import PrecomputedMasks


class ColourTracker:
    """Keeps to the protocol; the broken ones below differ in one thing each."""

    class Options(BaseModel):
        distance: float = Field(60.0, gt=0)

    def __init__(self, distance: float = 60.0) -> None:
        self.distance = distance

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        return cls(options.distance)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        x, y, width, height = (round(value) for value in prompt.box)
        pixels = frame.image[y : y + height, x : x + width].reshape(-1, 3)
        if prompt.mask is not None:
            pixels = frame.image[prompt.mask]
        if not len(pixels):
            raise InputError("The box or mask holds no pixel; give another one.")
        self.colour = pixels.mean(0)
        return self.step(frame)

    def step(self, frame: Frame) -> MaskEstimate:
        near = np.linalg.norm(frame.image - self.colour, axis=2) < self.distance
        if not near.any():
            return MaskEstimate(None, 0.0, "no pixel has the object's colour")
        return MaskEstimate(near.astype(np.float32), 0.5)


class Changed(ColourTracker):
    """Changes the good answer of every frame."""

    def step(self, frame: Frame) -> MaskEstimate:
        answer = super().step(frame)
        return answer if answer.mask is None else self.changed(answer, frame)

    def changed(self, answer: MaskEstimate, frame: Frame) -> MaskEstimate:
        return answer


class NoEstimate(Changed):
    def changed(self, answer, frame):
        return answer.mask


class Transposed(Changed):
    def changed(self, answer, frame):
        return replace(answer, mask=answer.mask.T)


class Cropped(Changed):
    def changed(self, answer, frame):
        return replace(answer, mask=answer.mask[:90, :96])


class Doubles(Changed):
    def changed(self, answer, frame):
        return replace(answer, mask=answer.mask.astype(np.float64))


class Bytes(Changed):
    def changed(self, answer, frame):
        return replace(answer, mask=answer.mask * 255)


class Logits(Changed):
    def changed(self, answer, frame):
        return replace(answer, mask=answer.mask * 2 - 1)


class NotNumbers(Changed):
    def changed(self, answer, frame):
        return replace(answer, mask=answer.mask / answer.mask.max() * np.float32(np.nan))


class HighScore(Changed):
    def changed(self, answer, frame):
        return replace(answer, score=7.5)


class NoScore(Changed):
    def changed(self, answer, frame):
        return replace(answer, score=None)


class NoReason(ColourTracker):
    def step(self, frame):
        answer = super().step(frame)
        return replace(answer, reason="") if answer.mask is None else answer


class ReasonIsNone(Changed):
    def changed(self, answer, frame):
        return replace(answer, reason=None)


class EmptyStart(ColourTracker):
    def init(self, frame, prompt):
        answer = super().init(frame, prompt)
        return replace(answer, mask=np.zeros(frame.size, np.float32))


class Painter(Changed):
    def changed(self, answer, frame):
        cv2.circle(frame.image, (5, 5), 3, (255, 0, 0))
        return answer


class PromptPainter(ColourTracker):
    def init(self, frame, prompt):
        answer = super().init(frame, prompt)
        if prompt.mask is not None:
            prompt.mask[:] = False
        return answer


class OneBuffer(ColourTracker):
    def init(self, frame, prompt):
        self.buffer = np.zeros(frame.size, np.float32)
        return super().init(frame, prompt)

    def step(self, frame):
        answer = super().step(frame)
        if answer.mask is None:
            return answer
        self.buffer[:] = answer.mask
        return replace(answer, mask=self.buffer)


class Dice(Changed):
    def changed(self, answer, frame):
        noise = np.random.random(answer.mask.shape) < 0.5
        return replace(answer, mask=answer.mask * noise.astype(np.float32))


class OpencvDice(Changed):
    def changed(self, answer, frame):
        noise = np.empty(answer.mask.shape, np.float32)
        cv2.randu(noise, 0, 1)
        return replace(answer, mask=answer.mask * noise)


class Shared(ColourTracker):
    """Remembers the colour in the class, where every other tracker of its kind finds it."""

    memory: ClassVar[dict] = {}

    def init(self, frame, prompt):
        answer = super().init(frame, prompt)
        self.memory["mask"] = answer.mask
        return answer

    def step(self, frame):
        answer = super().step(frame)
        before = self.memory.get("mask")
        if answer.mask is None or before is None or before.shape != frame.size:
            return answer
        return replace(answer, mask=np.maximum(answer.mask, before))


class Hoarder(ColourTracker):
    """Does not reset the state in init."""

    seen = 0

    def step(self, frame):
        self.seen += 1
        answer = super().step(frame)
        return replace(answer, score=0.5 / self.seen) if answer.mask is not None else answer


class NeedsTwoPixels(ColourTracker):
    """Ends in OpenCV's error where the object is small."""

    def init(self, frame, prompt):
        if min(prompt.box[2:]) < 2:
            raise ValueError("corners must not coincide")
        return super().init(frame, prompt)


class Terse(NeedsTwoPixels):
    def init(self, frame, prompt):
        if min(prompt.box[2:]) < 2:
            raise InputError("no")
        return super().init(frame, prompt)


class FailsInTheDark(ColourTracker):
    def step(self, frame):
        return replace(super().step(frame), score=1 / int(frame.image.max()))


class RefusesInTheDark(ColourTracker):
    def step(self, frame):
        if frame.image.max() == 0:
            raise InputError("The frame is black; switch on the light.")
        return super().step(frame)


class WideOnly(ColourTracker):
    def init(self, frame, prompt):
        if frame.size[0] > frame.size[1]:
            raise InputError("The frame is taller than it is wide; turn it around.")
        return super().init(frame, prompt)


BROKEN = {
    NoEstimate: "returned a ndarray of float32 instead of a MaskEstimate",
    Transposed: r"its mask has shape \(120, 90\), but the frame has \(90, 120\)",
    Cropped: r"its mask has shape \(90, 96\), but the frame has \(90, 120\)",
    Doubles: "float64 instead of float32",
    Bytes: "values from 0 to 255 instead of from 0 to 1",
    Logits: "values from -1 to 1 instead of from 0 to 1",
    NotNumbers: "values from nan to nan",
    HighScore: "its score is 7.5 instead of a number from 0 to 1",
    NoScore: "its score is None",
    NoReason: "an estimate without a mask must give a reason",
    ReasonIsNone: "the reason is None instead of text",
    EmptyStart: "the first frame's mask must show the object",
    Painter: "has changed the frame's image; draw on a copy",
    PromptPainter: "has changed the prompt's mask; work on a copy",
    OneBuffer: "the estimate for frame 0 was changed while later frames were tracked",
    Dice: "Two runs on the same frames differ at frame 0",
    OpencvDice: "Two runs on the same frames differ at frame 0",
    Shared: "depends on other clips tracked before or at the same time",
    NeedsTwoPixels: "a box of one pixel raises ValueError: corners must not coincide",
    Terse: "is refused with 'no'; write one sentence",
    FailsInTheDark: "a first frame of grey value 0 raises ZeroDivisionError: .*raise an InputError",
    RefusesInTheDark: "a clip that turns to grey value 0, frame 2 raises InputError",
    WideOnly: "97 x 131 pixels, prompted by a mask, frame 0 raises InputError",
}


@pytest.mark.parametrize(
    ("tracker", "told"), BROKEN.items(), ids=lambda value: getattr(value, "__name__", "")
)
def test_every_fault_is_found_and_told_in_a_sentence(tracker, told):
    with pytest.raises(AssertionError, match=told) as caught:
        check_tracker(tracker)
    sentence = str(caught.value).partition("\nassert")[0]
    assert sentence.endswith(".") and "\n" not in sentence


def test_every_broken_tracker_is_broken_by_its_fault_alone():
    check_tracker(ColourTracker)
    check_tracker(Changed)


def test_a_class_is_built_from_its_options():
    with pytest.raises(AssertionError, match="first frame's mask must show the object"):
        check_tracker(ColourTracker, distance=0.001)
    with pytest.raises(ValueError, match="greater than 0"):
        check_tracker(ColourTracker, distance=-1)


def test_a_factory_and_a_tracker_are_checked_too():
    check_tracker(lambda: ColourTracker(50.0))
    check_tracker(ColourTracker(50.0))
    with pytest.raises(AssertionError, match="reset the state in init"):
        check_tracker(Hoarder())
    check_tracker(Hoarder)  # each of them begins anew


def test_a_tracker_for_some_sizes_only_is_checked_on_those():
    check_tracker(WideOnly, sizes=[(90, 120), (60, 97)])


class WithoutOptions:
    init = step = from_options = None


class WithoutStep(ColourTracker):
    step = None


class TakesName(ColourTracker):
    class Options(BaseModel):
        name: str = ""


@pytest.mark.parametrize(
    ("thing", "told"),
    [
        (WithoutOptions, "no nested pydantic model Options"),
        (WithoutStep, "WithoutStep has no method step"),
        (TakesName, "field 'name'"),
        (7, "7 is not a plug-in"),
    ],
)
def test_what_is_no_plugin_is_told(thing, told):
    with pytest.raises(AssertionError, match=told):
        check_tracker(thing)


def test_global_random_generators_are_left_as_they_were():
    np.random.seed(5)
    expected = np.random.RandomState(5).random()
    check_tracker(ColourTracker, sizes=[(60, 80)], frames=2)
    assert np.random.random() == expected


NEED_NO_FILES = [
    info.name
    for info in list_plugins()
    if (info.group, info.package, info.status) == (TRACKERS, "tracking3d", "ok")
    and info.name != "onnx"  # needs a network: tests/trackers/onnx_tracker checks it with small ones
    and not (info.options or {}).get("required")
]


@pytest.mark.parametrize("name", NEED_NO_FILES)
def test_built_in_trackers_conform(name):
    tracker = load_plugin(TRACKERS, name)
    small = {"segmentation_size": 96} if "segmentation_size" in tracker.Options.model_fields else {}
    check_tracker(tracker, frames=3, **small)


def test_precomputed_masks_conform_on_clips_of_their_size(tmp_path):
    clip = moving_disc((90, 120), 4)
    masks = np.stack([np.roll(clip.mask, 2 * index, axis=1) for index in range(4)])
    np.savez(tmp_path / "masks.npz", masks=masks)
    check_tracker(PrecomputedMasks, sizes=[(90, 120)], path=str(tmp_path / "masks.npz"))
