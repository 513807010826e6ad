"""Several objects in one pass: each as if it were alone, and no one's failure is another's."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from refining_solver import CausalSolver, StandInSolver

from tracking3d import PipelineConfig, Status, load_config, track, track_objects
from tracking3d.errors import InputError, OutputError, PluginError
from tracking3d.frames import SkippedFrame
from tracking3d.pipeline.record import record, record_objects
from tracking3d.pipeline.session import SOLVERS
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.video import LatestFrames, open_source
from tracking3d.video.image_sequence import ImageSequence

SIZE = (48, 64)
LEFT, RIGHT = (6.0, 14.0, 16.0, 16.0), (36.0, 18.0, 20.0, 12.0)


def mask_of(box) -> np.ndarray:
    x, y, width, height = (int(value) for value in box)
    mask = np.zeros(SIZE, dtype=bool)
    mask[y : y + height, x : x + width] = True
    return mask


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """A red and a green thing that move to the right over noise, the green one faster."""
    rng = np.random.default_rng(0)
    images = np.repeat(rng.integers(60, 120, (1, *SIZE, 3), dtype=np.uint8), 5, axis=0)
    for n, image in enumerate(images):
        image[np.roll(mask_of(LEFT), n, 1)] = (200, 30, 30)
        image[np.roll(mask_of(RIGHT), 2 * n, 1)] = (30, 200, 30)
    return images


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)
    monkeypatch.setattr(CausalSolver, "faults", {})
    monkeypatch.setattr(StandInSolver, "revisit_faults", {})
    monkeypatch.setattr(StandInSolver, "seen", [])


@pytest.fixture
def source(images, tmp_path) -> ImageSequence:
    folder = tmp_path / "clip"
    folder.mkdir()
    for index, image in enumerate(images):
        write_image(folder / f"{index:03d}.png", image)
    return open_source(str(folder))


def settings(*overrides: str, policy: str = "continue", **sections) -> PipelineConfig:
    return load_config(
        overrides=["tracker.name=flow", "tracker.segmentation_size=64", *overrides],
        runtime={"on_plugin_failure": policy},
        **sections,
    )


def same(a, b) -> bool:
    return np.array_equal(a.mask, b.mask) and np.array_equal(a.T_cam_obj, b.T_cam_obj) and a.index == b.index


def test_each_is_tracked_as_if_it_were_alone(images):
    together = list(track_objects(images, boxes=[LEFT, RIGHT], config=settings()))
    assert [len(estimates) for estimates in together] == [2] * 5
    for number, box in enumerate((LEFT, RIGHT)):
        alone = list(track(images, box=box, config=settings()))
        assert all(
            same(estimates[number], estimate) for estimates, estimate in zip(together, alone, strict=True)
        )
    assert not np.array_equal(together[3][0].mask, together[3][1].mask)


def test_the_papers_solver_too(images):
    quick = load_config(
        preset="paper",
        overrides=["crop.size=32", "object.frequency=2", "object.texture_size=16", "solver.iterations=2"],
    )
    together = list(track_objects(images[:3], boxes=[LEFT, RIGHT], config=quick))
    for number, box in enumerate((LEFT, RIGHT)):
        alone = list(track(images[:3], box=box, config=quick))
        assert all(
            same(estimates[number], estimate) for estimates, estimate in zip(together, alone, strict=True)
        )


def test_masks_come_after_boxes(images):
    [first, *_] = track_objects(images, boxes=[RIGHT], masks=[mask_of(LEFT)], config=settings())
    np.testing.assert_array_equal(first[1].initial_mask, mask_of(LEFT))
    assert first[0].initial_mask[20, 40]


def test_frames_come_once_and_answers_as_they_do(images):
    taken: list[int] = []

    def camera():
        for number, image in enumerate(images):
            taken.append(number)
            yield SkippedFrame(1, "damaged") if number == 1 else image

    estimates = track_objects(camera(), boxes=[LEFT, RIGHT], config=settings())
    assert taken == []
    assert [next(estimates)[0].index for _ in range(3)] == [0, 2, 3]
    assert taken == [0, 1, 2, 3]


def test_one_object_is_a_tuple_of_one(images):
    assert [len(estimates) for estimates in track_objects(images, boxes=[LEFT], config=settings())] == [1] * 5


@pytest.mark.parametrize(
    ("objects", "message"),
    [
        ({}, "Give the objects with"),
        ({"boxes": [LEFT, (500, 1, 5, 5)]}, "outside frame 0"),
        ({"boxes": [LEFT, (1, 1, 0, 5)]}, "has no size"),
        ({"masks": [np.zeros(SIZE, bool)]}, "is empty"),
        ({"boxes": [LEFT], "masks": [np.ones((3, 3), bool)]}, "3 x 3 pixels"),
    ],
)
def test_objects_that_cannot_be_used_are_refused_before_anything_is_tracked(
    images, objects, message, tmp_path
):
    with pytest.raises(InputError, match=message):
        next(track_objects(images, config=settings(), **objects))
    with pytest.raises(InputError, match=message):
        record_objects(open_source(images), settings(), tmp_path / "run", **objects)
    assert not (tmp_path / "run").exists()


def test_precomputed_masks_are_of_one_object(images):
    config = load_config(tracker={"name": "precomputed", "path": "masks"})
    with pytest.raises(InputError, match="of one object"):
        next(track_objects(images, boxes=[LEFT, RIGHT], config=config))


def fails_for_the_first_object(monkeypatch, frame: int, error: Exception) -> None:
    """The stand-in solver knows its object by where its initial mask is."""
    step = CausalSolver.step

    def failing(self, state, given, mask):
        if given.index == frame and mask.binary[:, :30].any():
            raise error
        return step(self, state, given, mask)

    monkeypatch.setattr(CausalSolver, "step", failing)


def test_an_object_that_stops_is_answered_as_lost_and_the_other_goes_on(images, monkeypatch):
    fails_for_the_first_object(monkeypatch, 2, PluginError("The encoder gave up."))
    estimates = list(track_objects(images, boxes=[LEFT, RIGHT], config=settings()))
    for first, second in estimates[2:]:
        assert (first.status, first.failure, first.reason) == (Status.LOST, *["The encoder gave up."] * 2)
        assert first.T_cam_obj[0, 3] == 1  # where it was last
        assert not first.mask.any()
        assert second.status is Status.UNCERTAIN
        assert second.failure == ""
    alone = list(track(images, box=RIGHT, config=settings()))
    assert all(same(both[1], estimate) for both, estimate in zip(estimates, alone, strict=True))


def test_when_the_last_object_stops_so_does_all(images, monkeypatch):
    monkeypatch.setattr(CausalSolver, "faults", {3: PluginError("The encoder gave up.")})
    estimates = track_objects(images, boxes=[LEFT, RIGHT], config=settings())
    assert [both[0].index for both in (next(estimates), next(estimates), next(estimates))] == [0, 1, 2]
    with pytest.raises(PluginError, match="gave up"):
        next(estimates)


def test_every_object_has_a_run_folder_as_if_it_were_alone(source, tmp_path):
    told: list = []
    record_objects(source, settings(), tmp_path / "run", boxes=[LEFT, RIGHT], listener=told.append)
    assert [frame.index for frame in told] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4] * 2  # the second time refined
    assert [frame.refined for frame in told] == [False] * 10 + [True] * 10
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["object_0", "object_1"]
    for number, box in enumerate((LEFT, RIGHT)):
        record(source, settings(), tmp_path / f"alone_{number}", box=box)
        one, alone = RunReader(tmp_path / "run" / f"object_{number}"), RunReader(tmp_path / f"alone_{number}")
        assert one.state == "finished"
        estimates, expected = (
            [replace(frame, seconds=0.0, stages=None).to_json() for frame in run.frames]
            for run in (one, alone)
        )
        assert estimates == expected
        assert all(np.array_equal(one.mask(n), alone.mask(n)) for n in range(5))
        files = {path.relative_to(one.folder) for path in one.folder.rglob("*")}
        assert files == {path.relative_to(alone.folder) for path in alone.folder.rglob("*")}


def test_all_objects_are_refined_put_right_and_drawn_in_one_more_pass_each(source, tmp_path, monkeypatch):
    opened: list[int] = []
    iterate = ImageSequence.__iter__
    monkeypatch.setattr(ImageSequence, "__iter__", lambda self: opened.append(1) or iterate(self))
    config = settings("solver.final_refine=true")
    video = replace(source, rate=30.0)  # photos are looked at together once more
    record_objects(video, config, tmp_path / "run", boxes=[LEFT, RIGHT])
    assert len(opened) == 4
    for number in (0, 1):
        run = RunReader(tmp_path / "run" / f"object_{number}")
        assert [frame.refined for frame in run.frames] == [True] * 5
        assert run.description["refinement"]["frames"] == 5


def test_an_object_that_fails_leaves_the_others_finished(source, tmp_path, monkeypatch):
    fails_for_the_first_object(monkeypatch, 2, ZeroDivisionError("division by zero"))
    with pytest.raises(ZeroDivisionError) as caught:
        record_objects(source, settings(), tmp_path / "run", boxes=[LEFT, RIGHT])
    [note] = caught.value.__notes__
    assert note == f"The frames finished until then are in {tmp_path / 'run' / 'object_0'}."
    first, second = (RunReader(tmp_path / "run" / f"object_{number}") for number in (0, 1))
    assert (first.state, len(first.frames), first.description["error"]) == ("failed", 2, "division by zero")
    assert (second.state, len(second.frames)) == ("finished", 5)


def test_an_object_that_fails_in_the_second_pass_keeps_its_causal_answers(source, tmp_path, monkeypatch):
    revisit = StandInSolver.refine_frame

    def failing(self, state, frame, mask, T_cam_obj):
        if frame.index == 1 and mask.binary[:, :30].any():
            raise ZeroDivisionError("division by zero")
        return revisit(self, state, frame, mask, T_cam_obj)

    monkeypatch.setattr(StandInSolver, "refine_frame", failing)
    with pytest.raises(ZeroDivisionError):
        record_objects(source, settings("solver.final_refine=true"), tmp_path / "run", boxes=[LEFT, RIGHT])
    first, second = (RunReader(tmp_path / "run" / f"object_{number}") for number in (0, 1))
    assert (first.state, [frame.refined for frame in first.frames]) == ("failed", [False] * 5)
    assert (second.state, [frame.refined for frame in second.frames]) == ("finished", [True] * 5)


def test_ctrl_c_keeps_what_every_object_has(source, tmp_path, monkeypatch):
    monkeypatch.setattr(CausalSolver, "faults", {3: KeyboardInterrupt()})
    with pytest.raises(KeyboardInterrupt) as caught:
        record_objects(source, settings(), tmp_path / "run", boxes=[LEFT, RIGHT])
    assert len(caught.value.__notes__) == 2
    for number in (0, 1):
        run = RunReader(tmp_path / "run" / f"object_{number}")
        assert (run.state, [frame.index for frame in run.frames]) == ("interrupted", [0, 1, 2])


def test_where_all_fail_the_run_ends_at_once(source, tmp_path, monkeypatch):
    monkeypatch.setattr(CausalSolver, "faults", {1: ZeroDivisionError("division by zero")})
    told: list = []
    with pytest.raises(ZeroDivisionError):
        record_objects(source, settings(), tmp_path / "run", boxes=[LEFT, RIGHT], listener=told.append)
    assert [frame.index for frame in told] == [0, 0]


def test_folders_of_other_runs_are_left_alone(source, tmp_path):
    source = replace(source, selection=range(1))
    record(source, settings(), tmp_path / "one", box=LEFT)
    with pytest.raises(OutputError, match="a run of one object"):
        record_objects(source, settings(), tmp_path / "one", boxes=[LEFT, RIGHT], overwrite=True)
    record_objects(source, settings(), tmp_path / "three", boxes=[LEFT, RIGHT, LEFT])
    with pytest.raises(OutputError, match="a run of several objects, such as object_2"):
        record_objects(source, settings(), tmp_path / "three", boxes=[LEFT, RIGHT], overwrite=True)
    with pytest.raises(OutputError, match="already holds a run"):
        record_objects(source, settings(), tmp_path / "three", boxes=[LEFT, RIGHT, LEFT])
    record_objects(source, settings(), tmp_path / "three", boxes=[LEFT, RIGHT, RIGHT], overwrite=True)


def test_a_folder_that_cannot_be_used_leaves_no_lock_on_the_others(source, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "object_1").write_text("in the way")
    with pytest.raises(OutputError, match="object_1"):
        record_objects(source, settings(), tmp_path / "run", boxes=[LEFT, RIGHT])
    (tmp_path / "run" / "object_1").unlink()
    record_objects(source, settings(), tmp_path / "run", boxes=[LEFT, RIGHT])


def test_frames_that_a_live_source_dropped_are_recorded(images, tmp_path):
    """A source of 200 frames a second, far faster than even a solver that answers at once."""
    live = LatestFrames(open_source(np.repeat(images, 20, axis=0)), rate=200)
    record(live, settings("solver.final_refine=true"), tmp_path / "run", box=LEFT)
    run = RunReader(tmp_path / "run")
    dropped = run.description["skipped"]
    assert {one["reason"] for one in dropped} == {"dropped to keep up"}
    answered = [frame.index for frame in run.frames]
    assert answered[0] == 0
    assert sorted([*answered, *(one["index"] for one in dropped)]) == list(range(100))
    assert run.description["counts"]["skipped"] == len(dropped) > 0
    assert run.description["refinement"]["state"] == "skipped"
    assert json.loads((tmp_path / "run" / "run.json").read_text())["state"] == "finished"
