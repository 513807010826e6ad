"""Tracked both ways from a frame in the middle, and corrected in later frames: one run, one object, frames in order."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from refining_solver import StandInSolver
from resumable_runs import Stopped, assert_alike, settings

import tracking3d
from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.pipeline.prompted_tracker import PromptedTracker
from tracking3d.pipeline.record import record, record_objects
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import finish_state
from tracking3d.results.files import write_mask
from tracking3d.results.pictures import Pictures
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video import both_ways as both_ways_module
from tracking3d.video import open_source
from tracking3d.video.both_ways import both_ways

pytestmark = pytest.mark.usefixtures("stand_in_solver")
FRAMES, START = 7, 3


@pytest.fixture
def online(monkeypatch, stand_in_solver) -> None:
    """The solver itself."""
    monkeypatch.setitem(SOLVERS, "online", OnlineSolver)


CAUSAL = "solver.final_refine=false"


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def run(clip, images, folder: Path, *overrides: str, **given) -> RunReader:
    """Without evidence, which is weighed alike whichever way the frames come."""
    given.setdefault("mask", clip.masks[given.get("start_frame") or 0])
    record(open_source(str(images)), settings("object.refine_masks=false", *overrides), folder, **given)
    return RunReader(folder)


def stopped_in(monkeypatch, call: int, clip, images, folder, *overrides: str, **given) -> None:
    """Stop a run in the ``call``-th frame that is tracked, counted from 0."""
    calls, step = [], Session.step

    def stopping(self, *arguments):
        calls.append(1)
        if len(calls) == call + 1:
            raise Stopped
        return step(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "step", stopping)
        with pytest.raises(Stopped):
            run(clip, images, folder, *overrides, resume=True, **given)


def items(count: int) -> list[Frame | SkippedFrame]:
    return [
        SkippedFrame(index, "torn") if index == 2 else Frame(index, np.full((2, 2, 3), index, np.uint8))
        for index in range(count)
    ]


@pytest.mark.parametrize("most", [1, 25, 10**9])
def test_frames_come_forwards_and_then_backwards_however_little_memory_there_is(monkeypatch, most):
    monkeypatch.setattr(both_ways_module, "MOST_BYTES", most)
    found = list(both_ways(lambda: items(7), 4, "here"))
    assert [item.index for item in found] == [4, 5, 6, 3, 2, 1, 0]
    assert isinstance(found[4], SkippedFrame)
    assert all(item.image[0, 0, 0] == item.index for item in found if isinstance(item, Frame))


def test_the_first_and_the_last_frame_have_one_way_only():
    assert [item.index for item in both_ways(lambda: items(4), 0, "here")] == [0, 1, 2, 3]
    assert [item.index for item in both_ways(lambda: items(4), 3, "here")] == [3, 2, 1, 0]
    with pytest.raises(InputError, match="start_frame=4 is not among the selected frames of here"):
        list(both_ways(lambda: items(4), 4, "here"))


def test_both_ways_are_tracked_with_one_model(clip, monkeypatch, online):
    begun, init = [], OnlineSolver.init

    def counted(self, *given):
        begun.append(1)
        return init(self, *given)

    monkeypatch.setattr(OnlineSolver, "init", counted)
    estimates, order = {}, []
    for estimate in tracking3d.track(
        list(clip.images), mask=clip.masks[START], start_frame=START, config=settings()
    ):
        order.append(estimate.index)
        estimates |= {answer.index: answer for answer in (*estimate.revised, estimate)}
    assert order == [3, 4, 5, 6, 2, 1, 0]
    assert len(begun) == 1
    assert "lost" not in [estimates[index].status for index in range(FRAMES)]
    assert min(iou(estimates[index].mask, clip.masks[index]) for index in range(FRAMES)) > 0.8


@pytest.mark.slow
def test_backwards_is_as_good_as_the_same_frames_the_other_way_round(clip, online):
    def masks(**given):
        found = {}
        for estimate in tracking3d.track(config=settings(), **given):
            found |= {answer.index: answer.mask for answer in (*estimate.revised, estimate)}
        return found

    last = FRAMES - 1
    back = masks(frames=list(clip.images), mask=clip.masks[last], start_frame=last)
    turned = masks(frames=list(clip.images[::-1]), mask=clip.masks[last])
    assert [iou(back[last - index], turned[index]) for index in range(FRAMES)] == [1.0] * FRAMES


@pytest.fixture(scope="module")
def both(clip, images, tmp_path_factory) -> dict[str, Path]:
    """Runs both ways that nobody stopped, with a final refinement and without."""
    runs = {name: tmp_path_factory.mktemp("both") / name for name in ("refined", "causal")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SOLVERS, "online", StandInSolver)
        run(clip, images, runs["refined"], start_frame=START)
        run(clip, images, runs["causal"], CAUSAL, start_frame=START)
    return runs


def test_a_run_folder_has_the_frames_in_order(clip, both):
    reader = RunReader(both["refined"])
    assert [frame.index for frame in reader.frames] == list(range(FRAMES))
    assert reader.description["prompt"]["start_frame"] == START
    assert reader.description["prompt"]["first_frame"] == START
    assert reader.description["refinement"]["frames"] == FRAMES
    written = [line.index for line in read_records(both["causal"] / layout.FRAMES) if not line.revision]
    assert written == [3, 4, 5, 6, 2, 1, 0]
    for frame in reader.frames:
        assert iou(reader.mask(frame.index), clip.masks[frame.index]) > 0.8


def test_the_video_is_drawn_in_order(clip, images, tmp_path, monkeypatch):
    drawn, add = [], Pictures.add

    def noted(self, frame, *given):
        drawn.append(frame.index)
        return add(self, frame, *given)

    monkeypatch.setattr(Pictures, "add", noted)
    run(clip, images, tmp_path / "run", CAUSAL, start_frame=START)
    assert drawn[-FRAMES:] == list(range(FRAMES))
    with av.open(str(tmp_path / "run" / layout.OVERLAY)) as video:
        assert sum(1 for _ in video.decode(video=0)) == FRAMES


@pytest.mark.parametrize("call", [2, 4, 5])
def test_a_stopped_run_goes_on_in_either_direction(clip, images, both, tmp_path, monkeypatch, call):
    stopped_in(monkeypatch, call, clip, images, tmp_path / "run", CAUSAL, start_frame=START)
    run(clip, images, tmp_path / "run", CAUSAL, start_frame=START, resume=True)
    assert_alike(tmp_path / "run", both["causal"])


def test_masks_that_were_made_elsewhere_go_both_ways_too(clip, images, tmp_path, monkeypatch):
    for index, mask in enumerate(clip.masks):
        (tmp_path / "masks").mkdir(exist_ok=True)
        write_mask(tmp_path / "masks" / f"{index:03d}.png", mask)
    precomputed = ("tracker.name=precomputed", f"tracker.path={tmp_path / 'masks'}", CAUSAL)
    whole = run(clip, images, tmp_path / "whole", *precomputed, mask=None, start_frame=START)
    for index in range(FRAMES):
        assert (whole.initial_mask(index) == clip.masks[index]).all()
    stopped_in(monkeypatch, 5, clip, images, tmp_path / "run", *precomputed, mask=None, start_frame=START)
    run(clip, images, tmp_path / "run", *precomputed, mask=None, start_frame=START, resume=True)
    assert_alike(tmp_path / "run", tmp_path / "whole")


@pytest.mark.slow
def test_the_state_of_the_online_solver_is_kept_across_the_turn(clip, images, tmp_path, monkeypatch, online):
    run(clip, images, tmp_path / "whole", start_frame=START)
    stopped_in(monkeypatch, 5, clip, images, tmp_path / "run", start_frame=START)
    run(clip, images, tmp_path / "run", start_frame=START, resume=True)
    assert_alike(tmp_path / "run", tmp_path / "whole")


@pytest.mark.slow
def test_a_correction_puts_mask_and_pose_where_the_object_is(clip, online):
    """The camera is covered for four frames; then the user says where the object is, since csrt does not find it.

    Six frames of 4 degrees tell too little of its shape for the poses after them to be believed.
    """
    long = synthesize(SyntheticSpec(frames=14, size=(160, 120), supersample=1, degrees_per_frame=4))
    frames = [
        image if not 6 <= index < 10 else np.full_like(image, 90) for index, image in enumerate(long.images)
    ]

    def tracked(corrections):
        estimates = {}
        config = load_config(tracker="csrt")
        for estimate in tracking3d.track(frames, mask=long.masks[0], corrections=corrections, config=config):
            estimates |= {answer.index: answer for answer in (*estimate.revised, estimate)}
        return estimates

    alone, corrected = tracked([]), tracked([Correction(10, mask=long.masks[10])])
    assert alone[9].status != "tracked" and corrected[9].T_cam_obj == pytest.approx(alone[9].T_cam_obj)
    for index in range(10, 14):
        assert iou(alone[index].mask, long.masks[index]) < 0.8
        assert iou(corrected[index].mask, long.masks[index]) > 0.9
        assert corrected[index].diagnostics["mask_iou"] > 0.8  # of the silhouette with the mask


def test_a_run_goes_on_from_the_frame_that_it_started_from_only(clip, images, tmp_path, monkeypatch):
    stopped_in(monkeypatch, 4, clip, images, tmp_path / "run", CAUSAL, start_frame=START)
    with pytest.raises(InputError, match="the frame to start from was 3 and is None"):
        run(clip, images, tmp_path / "run", CAUSAL, mask=clip.masks[START], resume=True)


def test_frames_that_come_once_only_cannot_be_gone_through_backwards(clip, tmp_path):
    with pytest.raises(InputError, match="can be read only once and cannot be tracked backwards"):
        tracking3d.track(iter(list(clip.images)), mask=clip.masks[1], start_frame=1)
    with pytest.raises(InputError, match="can be read only once"):
        record(
            open_source(iter(list(clip.images))), None, tmp_path / "run", mask=clip.masks[1], start_frame=1
        )
    assert not (tmp_path / "run").exists()
    for wrong in (-1, 1.5, "3", True):
        with pytest.raises(InputError, match="is not a frame index"):
            tracking3d.track(list(clip.images), mask=clip.masks[0], start_frame=wrong)


def wrong_place(clip) -> np.ndarray:
    """A mask of the background."""
    mask = np.zeros_like(clip.masks[0])
    mask[:12, :12] = True
    assert not (mask & clip.masks[0]).any()
    return mask


CORRECTED = 4


def test_from_a_correction_on_the_object_is_what_it_says(clip, images, tmp_path):
    corrections = [Correction(CORRECTED, mask=clip.masks[CORRECTED])]
    before = run(clip, images, tmp_path / "before", CAUSAL, mask=wrong_place(clip))
    after = run(clip, images, tmp_path / "after", CAUSAL, mask=wrong_place(clip), corrections=corrections)
    for index in range(FRAMES):
        mask = after.initial_mask(index)
        if index < CORRECTED:
            assert (after.mask(index) == before.mask(index)).all()
            assert (mask == before.initial_mask(index)).all()
        else:
            assert iou(mask, clip.masks[index]) > 0.85
    assert (after.initial_mask(CORRECTED) == clip.masks[CORRECTED]).all()
    [told] = after.description["prompt"]["corrections"]
    assert (told["frame"], told["box"], told["points"]) == (CORRECTED, None, None)


def test_a_tracker_that_is_on_the_object_keeps_what_it_has_learnt(clip):
    tracker = PromptedTracker(settings().tracker, make_prompt(Frame(0, clip.images[0]), mask=clip.masks[0]))
    tracker.start(Frame(0, clip.images[0]))
    mask = clip.masks[1]
    estimate = tracker.step(Frame(1, clip.images[1]), make_prompt(Frame(1, clip.images[1]), mask=mask))
    assert (estimate.binary == mask).all()
    assert not tracker.restarted
    elsewhere = make_prompt(Frame(2, clip.images[2]), mask=wrong_place(clip))
    tracker.step(Frame(2, clip.images[2]), elsewhere)
    assert tracker.restarted
    assert iou(tracker.step(Frame(3, clip.images[3])).binary, wrong_place(clip)) > 0.5


def test_boxes_and_points_correct_too_and_backwards_as_well(clip):
    x, y = np.argwhere(clip.masks[5])[:, ::-1].mean(0)
    corrections = [
        Correction(5, points=[(x, y, 1), (2, 2, 0)]),
        Correction(1, box=make_prompt(Frame(1, clip.images[1]), mask=clip.masks[1]).box),
    ]
    estimates = {}
    for estimate in tracking3d.track(
        list(clip.images),
        mask=clip.masks[START],
        start_frame=START,
        corrections=corrections,
        config=settings(),
    ):
        estimates[estimate.index] = estimate
    assert min(iou(estimates[index].initial_mask, clip.masks[index]) for index in (0, 1, 5, 6)) > 0.7


def test_a_run_that_was_stopped_takes_a_correction_of_a_later_frame(clip, images, tmp_path, monkeypatch):
    wrong, given = wrong_place(clip), [Correction(CORRECTED, mask=clip.masks[CORRECTED])]
    run(clip, images, tmp_path / "whole", CAUSAL, mask=wrong, corrections=given)
    stopped_in(monkeypatch, 3, clip, images, tmp_path / "run", CAUSAL, mask=wrong)
    stopped_in(monkeypatch, 2, clip, images, tmp_path / "run", CAUSAL, mask=wrong, corrections=given)
    run(clip, images, tmp_path / "run", CAUSAL, mask=wrong, corrections=given, resume=True)
    assert_alike(tmp_path / "run", tmp_path / "whole")


def test_a_finished_run_is_computed_again_where_a_frame_is_corrected(clip, images, tmp_path, caplog):
    wrong, given = wrong_place(clip), [Correction(CORRECTED, mask=clip.masks[CORRECTED])]
    run(clip, images, tmp_path / "whole", CAUSAL, mask=wrong, corrections=given)
    run(clip, images, tmp_path / "run", CAUSAL, mask=wrong)
    finish_state(tmp_path / "run", 0)
    run(clip, images, tmp_path / "run", CAUSAL, mask=wrong, corrections=given, resume=True)
    assert "No checkpoint before frame 4 is saved" in caplog.text
    assert_alike(tmp_path / "run", tmp_path / "whole")
    created = RunReader(tmp_path / "run").description["created"]
    run(clip, images, tmp_path / "run", CAUSAL, mask=wrong, corrections=given, resume=True)
    assert RunReader(tmp_path / "run").description["created"] == created
    with pytest.raises(InputError, match="it was corrected in frame 4, which is not requested now"):
        run(clip, images, tmp_path / "run", CAUSAL, mask=wrong, resume=True)


def test_a_frame_that_never_comes_is_told(clip, images, tmp_path, caplog):
    class Unselected:
        """A source that does not say which frames it has."""

        name, count, fps, intrinsics, intrinsics_origin, repeatable = "here", None, None, None, "", True

        def __iter__(self):
            return iter(open_source(str(images)))

    given = [Correction(99, box=(1, 1, 5, 5))]
    record(Unselected(), settings(CAUSAL), tmp_path / "run", mask=clip.masks[0], corrections=given)
    assert "Frame 99, which was to be corrected, could not be read: there are 7 frames" in caplog.text


def test_each_object_has_its_own_corrections(clip, images, tmp_path):
    x, y, width, height = make_prompt(Frame(0, clip.images[0]), mask=clip.masks[0]).box
    record_objects(
        open_source(str(images)),
        settings(CAUSAL),
        tmp_path / "run",
        boxes=[(x, y, width, height), (0, 0, 12, 12)],
        corrections=[Correction(CORRECTED, mask=clip.masks[CORRECTED], object=1)],
    )
    told = [RunReader(tmp_path / "run" / f"object_{n}").description["prompt"]["corrections"] for n in (0, 1)]
    assert [len(one) for one in told] == [0, 1]
    second = RunReader(tmp_path / "run" / "object_1")
    assert (second.initial_mask(CORRECTED) == clip.masks[CORRECTED]).all()
