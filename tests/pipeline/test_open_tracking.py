"""How a tracking begins: what is asked for is checked, then the first frame makes prompts, tracker and sessions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from tracking3d import load_config
from tracking3d.errors import InputError
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.pipeline.open_tracking import NoFrameError, open_tracking, request_tracking
from tracking3d.pipeline.record import RecordOptions, record_tracking
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source

SIZE = 48, 64
BOX, OTHER = (10.0, 8.0, 20.0, 16.0), (36.0, 20.0, 20.0, 20.0)


def picture(seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 255, (*SIZE, 3), np.uint8)


def mask_of(box: tuple[float, float, float, float]) -> np.ndarray:
    x, y, width, height = map(int, box)
    mask = np.zeros(SIZE, bool)
    mask[y : y + height, x : x + width] = True
    return mask


@dataclass
class Source:
    """Frames of which some cannot be decoded; says whether it was closed."""

    frames: list[Frame | SkippedFrame]
    name: str = "a source"
    fps: float | None = None
    intrinsics: None = None
    intrinsics_origin: str = ""
    repeatable: bool = True
    closed: list[bool] = field(default_factory=list)

    @property
    def count(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        try:
            yield from self.frames
        finally:
            self.closed.append(True)


def settings(tracker: str = "flow"):
    return load_config(tracker={"name": tracker})


def two() -> PromptSet:
    return PromptSet(boxes=[BOX], masks=[mask_of(OTHER)], as_lists=True)


def test_objects_are_counted_boxes_first_then_masks_then_points():
    prompts = PromptSet([BOX], [mask_of(OTHER)], [[(20, 16, 1), (50, 40, 0)]], as_lists=True)
    made = prompts.make(
        Frame(0, np.where(mask_of(BOX)[..., None], 200, 60).astype(np.uint8).repeat(3, 2)), ""
    )
    assert len(prompts) == len(made) == 3
    assert made[0].box == BOX and made[0].mask is None
    assert made[1].box == OTHER and (made[1].mask == mask_of(OTHER)).all()
    assert made[2].points.shape == (2, 3)


def test_an_empty_set_is_one_object_that_the_mask_tracker_knows():
    assert PromptSet().make(Frame(0, picture()), "precomputed") == [None]
    PromptSet().check(needed=False)


@pytest.mark.parametrize(
    ("prompts", "message"),
    [
        (PromptSet(), "one of a box, a mask or points"),
        (PromptSet.of_one(BOX, mask_of(BOX)), "one of a box, a mask or points"),
        (PromptSet.of_one(box=(1, 1, 0, 5)), r"^box=1,1,0,5 has no size"),
        (PromptSet(as_lists=True), "boxes, masks or points"),
        (PromptSet(boxes=[BOX, (1, 1, 0, 5)], as_lists=True), r"^boxes\[1\]=1,1,0,5 has no size"),
        (PromptSet(boxes="1,2,3,4", as_lists=True), "give a list with one item per object"),
    ],
)
def test_what_cannot_be_a_prompt_is_refused_before_the_first_frame(prompts, message):
    source = Source([Frame(0, picture())])
    with pytest.raises(InputError, match=message):
        request_tracking(source, settings(), prompts)
    assert not source.closed  # it was never begun


def test_every_object_has_a_session_its_prompt_and_its_corrections():
    corrections = [Correction(3, box=BOX, object=0), Correction(2, box=OTHER, object=1)]
    request = request_tracking(Source([Frame(0, picture())]), settings(), two(), corrections)
    with open_tracking(request) as opened:
        first, second = opened.objects
    assert first.session is not second.session
    assert first.prompt.box == BOX and second.prompt.box == OTHER
    assert list(first.corrections) == [3] and list(second.corrections) == [2]


def test_all_frames_come_those_before_the_first_that_can_be_read_included():
    frames = [SkippedFrame(0, "damaged"), Frame(1, picture()), Frame(2, picture(1))]
    source = Source(frames)
    request = request_tracking(source, settings(), PromptSet.of_one(BOX), skip_damaged=True)
    with open_tracking(request) as opened:
        assert opened.first.index == 1
        assert [frame.index for frame in opened.frames] == [0, 1, 2]
    assert source.closed
    with (
        pytest.raises(InputError, match="first frame"),
        open_tracking(request_tracking(Source(frames), settings(), PromptSet.of_one(BOX))),
    ):
        pass


def test_the_source_is_closed_when_it_is_left_early():
    source = Source([Frame(index, picture(index)) for index in range(5)])
    with open_tracking(request_tracking(source, settings(), PromptSet.of_one(BOX))):
        assert not source.closed
    assert source.closed


def test_a_source_without_a_frame_is_an_error_of_its_own():
    request = request_tracking(
        Source([SkippedFrame(0, "damaged")]), settings(), PromptSet.of_one(BOX), (), True
    )
    with (
        pytest.raises(NoFrameError, match="a source has no frame that can be decoded"),
        open_tracking(request),
    ):
        pass


def test_a_named_tracker_needs_no_reason_and_auto_gives_one():
    frames = [Frame(0, picture())]
    with open_tracking(request_tracking(Source(frames), settings(), PromptSet.of_one(BOX))) as opened:
        assert (opened.config.tracker.name, opened.tracker_choice) == ("flow", None)
    with open_tracking(request_tracking(Source(frames), settings("auto"), PromptSet.of_one(BOX))) as opened:
        assert opened.config.tracker.name != "auto"
        assert opened.tracker_choice.startswith(opened.config.tracker.name)


def test_command_and_selection_are_written_down(tmp_path):
    images = [picture(index) for index in range(3)]
    config = load_config(tracker={"name": "flow"}, solver={"final_refine": False})
    request = request_tracking(open_source(images, "1:3"), config, PromptSet.of_one(BOX))
    [run] = record_tracking(request, tmp_path / "run", RecordOptions("a command", "1:3"))
    assert (run.description["command"], run.description["selection"]) == ("a command", "1:3")
    assert [record.index for record in run.frames] == [1, 2]
