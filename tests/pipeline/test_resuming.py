"""A stopped run goes on from its last finished frame, to the same answers."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from recorded_runs import set_format
from refining_solver import CausalSolver, StandInSolver
from resumable_runs import Stopped, assert_alike, files_of, settings, stop_at

from tracking3d import load_config
from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.open_tracking import request_tracking
from tracking3d.pipeline.record import RecordOptions, record, record_objects, record_tracking
from tracking3d.pipeline.recorder import ObjectRecorder
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results import layout, run_writer
from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.checkpoint.run_state import RunState
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_writer import FrameLines
from tracking3d.trackers.flow import FlowTracker
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source

pytestmark = pytest.mark.usefixtures("stand_in_solver")
FRAMES = 6


@pytest.fixture
def online(monkeypatch, stand_in_solver) -> None:
    """The solver itself."""
    monkeypatch.setitem(SOLVERS, "online", OnlineSolver)


@pytest.fixture(scope="module")
def whole(clip, images, tmp_path_factory) -> dict[str, Path]:
    """Runs that nobody stopped, by solver."""
    runs = {}
    with pytest.MonkeyPatch.context() as patch:
        for name, solver in (("stand_in", StandInSolver), ("online", OnlineSolver)):
            patch.setitem(SOLVERS, "online", solver)
            runs[name] = tmp_path_factory.mktemp("whole") / name
            record(open_source(str(images)), settings(), runs[name], mask=clip.masks[0])
    return runs


def stopped(monkeypatch, clip, images, folder, owner, name, call, error=None) -> None:
    with monkeypatch.context() as patch:
        stop_at(patch, owner, name, call, error)
        with pytest.raises((Stopped, Exception)):
            record(open_source(str(images)), settings(), folder, mask=clip.masks[0], resume=True)


def let_go(writer: run_writer.RunWriter, *_) -> None:
    """Close what the system closes with a process, and write nothing."""
    writer._lines.close()
    writer._pictures.close()
    if writer._refinement:
        writer._refinement.pictures.close()


def give_up_without_saving(recorder: ObjectRecorder, error: BaseException) -> None:
    """End the thread that writes, which may use a file that is closed then, and save no state."""
    recorder._work.end()
    let_go(recorder._writer)


MOMENTS = {
    "in the first frame": (Session, "step", 0),
    "in a later frame": (Session, "step", 3),
    "before its state is noted": (RunState, "advance", 3),
    "before the first state": (Checkpoint, "save", 0),
    "while all is solved once more": (Session, "refine", 0),
    "in a second answer": (Session, "refine_frame", 2),
    "before its second state is noted": (RunState, "advance", FRAMES + 3),
    "while masks are taken over": (FrameLines, "append", FRAMES),
    "while the mesh is written": (run_writer.RunWriter, "_finish", 0),
}


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("killed", [False, True], ids=["stopped", "killed"])
def test_a_run_that_was_stopped_goes_on_to_the_same_end(
    clip, images, whole, tmp_path, monkeypatch, moment, killed
):
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        if killed:  # nothing is written at the end, as little as after SIGKILL
            patch.setattr(run_writer.RunWriter, "finish", let_go)
            patch.setattr(ObjectRecorder, "give_up", give_up_without_saving)
            if moment == "while the mesh is written":
                pytest.skip("there is no such moment: the end is not written")
        stopped(patch, clip, images, folder, *MOMENTS[moment])
    answered = []
    for name in ("step", "refine_frame"):
        method = getattr(Session, name)

        def told(self, frame, *given, method=method, name=name):
            answered.append((name, frame.index))
            return method(self, frame, *given)

        monkeypatch.setattr(Session, name, told)
    record(open_source(str(images)), settings(), folder, mask=clip.masks[0], resume=True)
    assert_alike(folder, whole["stand_in"])
    expected = [("step", n) for n in range(FRAMES)] + [("refine_frame", n) for n in range(FRAMES)]
    begun = {
        "in a later frame": 3,
        "before its state is noted": 3,
        "while all is solved once more": FRAMES,
        "in a second answer": FRAMES + 2,
        "before its second state is noted": FRAMES + 3,
        "while masks are taken over": 2 * FRAMES,
        "while the mesh is written": 2 * FRAMES,
    }
    if killed:  # the state is that of the first frame, or of the start of the refinement
        begun |= {"in a later frame": 1, "before its state is noted": 1}
        begun |= {"in a second answer": FRAMES, "before its second state is noted": FRAMES}
    assert answered == expected[begun.get(moment, 0) :]
    with av.open(str(folder / layout.OVERLAY)) as video:
        assert sum(1 for _ in video.decode(video=0)) == FRAMES


@pytest.mark.slow
@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [(Session, "step", 4), (Session, "refine_frame", 3)],
    ids=["tracked", "refined"],
)
def test_the_state_of_the_online_solver_is_kept_whole(
    clip, images, whole, tmp_path, monkeypatch, online, owner, name, call
):
    stopped(monkeypatch, clip, images, tmp_path / "run", owner, name, call)
    source = open_source(str(images))
    record(source, settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert_alike(tmp_path / "run", whole["online"])


def test_a_run_may_be_stopped_again_and_again(clip, images, whole, tmp_path, monkeypatch):
    for _ in range(FRAMES - 1):
        stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 1)
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert_alike(tmp_path / "run", whole["stand_in"])
    resumed = RunReader(tmp_path / "run").description["resumed"]
    assert [one["frames"] for one in resumed] == [1, 2, 3, 4, 5]


def test_a_plugin_that_fails_and_is_mended_costs_nothing(clip, images, whole, tmp_path, monkeypatch):
    stopped(monkeypatch, clip, images, tmp_path / "run", FlowTracker, "step", 2, ZeroDivisionError())
    assert RunReader(tmp_path / "run").state == "failed"
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert_alike(tmp_path / "run", whole["stand_in"])


def test_several_objects_go_on_from_where_each_is(clip, images, tmp_path, monkeypatch):
    """The second object is one frame behind, and the first is finished when it is stopped again."""

    def run(folder, resume=True):
        record_objects(
            open_source(str(images)), settings(), folder, masks=[clip.masks[0], clip.masks[0]], resume=resume
        )

    run(tmp_path / "whole", resume=False)
    for owner, name, call in ((Session, "step", 7), (run_writer.RunWriter, "finish", 1)):
        with monkeypatch.context() as patch:
            stop_at(patch, owner, name, call)
            with pytest.raises(Stopped):
                run(tmp_path / "run")
    states = [RunReader(tmp_path / "run" / f"object_{number}").state for number in (0, 1)]
    assert states == ["finished", "interrupted"]
    run(tmp_path / "run")
    for number in (0, 1):
        assert_alike(tmp_path / "run" / f"object_{number}", tmp_path / "whole" / f"object_{number}")


def test_a_resumed_run_names_the_lens_that_the_stopped_one_had_come_to(clip, images, tmp_path, monkeypatch):
    class FindsTheLens(CausalSolver):
        def step(self, state, frame, mask):
            state, estimate = super().step(state, frame, mask)
            return state, replace(
                estimate, camera=Camera.from_fov(80, 64, 20.0)
            ) if frame.index == 2 else estimate

    monkeypatch.setitem(SOLVERS, "online", FindsTheLens)
    stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 4)
    assert RunReader(tmp_path / "run").camera == Camera.from_fov(80, 64, 20.0)
    named = []
    with monkeypatch.context() as patch:
        step = Session.step
        patch.setattr(
            Session,
            "step",
            lambda *given: (named.append(RunReader(tmp_path / "run").camera), step(*given))[1],
        )
        record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert named and all(camera == Camera.from_fov(80, 64, 20.0) for camera in named)
    assert RunReader(tmp_path / "run").camera == Camera.from_fov(80, 64, 20.0)


def test_what_was_handed_back_to_the_tracker_is_handed_back_again(clip, images, tmp_path, monkeypatch):
    monkeypatch.setattr("tracking3d.pipeline.session.corrects", lambda estimate: estimate.index in (1, 3))
    corrections = []
    correct = FlowTracker.correct
    monkeypatch.setattr(
        FlowTracker,
        "correct",
        lambda self, frame, mask: (corrections.append((frame.index, mask.sum())), correct(self, frame, mask)),
    )
    config = settings("solver.tracker_feedback=true")
    record(open_source(str(images)), config, tmp_path / "whole", mask=clip.masks[0])
    expected, corrections[:] = list(corrections), []
    with monkeypatch.context() as patch:
        stop_at(patch, Session, "step", 4)
        with pytest.raises(Stopped):
            record(open_source(str(images)), config, tmp_path / "run", mask=clip.masks[0])
    corrections.clear()
    record(open_source(str(images)), config, tmp_path / "run", mask=clip.masks[0], resume=True)
    assert corrections == expected
    assert_alike(tmp_path / "run", tmp_path / "whole")


def test_a_tracker_that_keeps_its_memory_does_not_see_the_frames_again(clip, images, tmp_path, monkeypatch):
    np.save(tmp_path / "masks.npy", clip.masks)
    config = load_config(
        tracker={"name": "precomputed", "path": str(tmp_path / "masks.npy")},
    )
    record(open_source(str(images)), config, tmp_path / "whole")
    with monkeypatch.context() as patch:
        stop_at(patch, Session, "step", 4)
        with pytest.raises(Stopped):
            record(open_source(str(images)), config, tmp_path / "run")
    asked = []
    replay = Session.replay
    monkeypatch.setattr(
        Session, "replay", lambda self, *given: (asked.append(given), replay(self, *given))[1]
    )
    record(open_source(str(images)), config, tmp_path / "run", resume=True)
    assert not asked
    assert_alike(tmp_path / "run", tmp_path / "whole")


def test_a_tracker_with_a_mind_of_its_own_is_told_of(clip, images, tmp_path, monkeypatch, caplog):
    stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 4)
    init = FlowTracker.init
    monkeypatch.setattr(
        FlowTracker,
        "init",
        lambda self, frame, prompt: (init(self, frame, prompt), _shifted(init(self, frame, prompt)))[1],
    )
    with caplog.at_level(logging.WARNING):
        record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert sum("gives another mask of 000.png" in message for message in caplog.messages) == 1


def _shifted(estimate):
    return type(estimate)(np.roll(estimate.mask, 3, axis=0), estimate.score, estimate.reason)


def test_frames_that_were_skipped_stay_skipped_once(clip, images, tmp_path, monkeypatch):
    folder = tmp_path / "damaged"
    folder.mkdir()
    for file in images.iterdir():
        (folder / file.name).write_bytes(b"no image" if file.stem in ("001", "003") else file.read_bytes())
    told: list[int] = []
    for name, stop in (("whole", None), ("run", 3), ("run", None)):
        with monkeypatch.context() as patch:
            if stop:
                stop_at(patch, Session, "step", stop)
            try:
                record(
                    open_source(str(folder)), settings(), tmp_path / name, mask=clip.masks[0],
                    resume=name == "run", listener=lambda frame: told.append(frame.index),
                )  # fmt: skip
            except Stopped:
                told.clear()
    assert told == [0, 1, 2, 3, 4, 5, 0, 2, 4, 5]
    assert [one["index"] for one in RunReader(tmp_path / "run").description["skipped"]] == [1, 3]
    assert_alike(tmp_path / "run", tmp_path / "whole")


def test_a_finished_run_is_left_alone(clip, images, whole, tmp_path):
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0])
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")}
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")} == before


def test_resuming_what_was_never_begun_begins_it(clip, images, whole, tmp_path):
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert_alike(tmp_path / "run", whole["stand_in"])


@pytest.mark.parametrize("done", [False, True], ids=["stopped", "finished"])
def test_other_settings_or_another_source_are_refused_with_the_difference(
    clip, images, tmp_path, monkeypatch, done
):
    folder = tmp_path / "run"
    if done:
        record(open_source(str(images)), settings(), folder, mask=clip.masks[0])
    else:
        stopped(monkeypatch, clip, images, folder, Session, "step", 3)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    other = tmp_path / "other"
    other.mkdir()
    for file in images.iterdir():
        (other / file.name).write_bytes(file.read_bytes())
    write_image(other / "000.png", clip.images[0][::-1].copy())
    mask = clip.masks[0].copy()
    mask[30:34, 30:34] = False
    for what, source, config, prompt, selection in (
        ("crop.size was 32 and is 48", images, settings("crop.size=48"), {"mask": clip.masks[0]}, None),
        ("the first image is another one", other, settings(), {"mask": clip.masks[0]}, None),
        ("the object's mask is another one", images, settings(), {"mask": mask}, None),
        ("the object's box was .* and is", images, settings(), {"box": (10.0, 10.0, 30.0, 30.0)}, None),
        ("selection of frames was None and is 0:5", images, settings(), {"mask": clip.masks[0]}, "0:5"),
    ):
        with pytest.raises(InputError, match=what) as error:
            request = request_tracking(
                open_source(str(source), selection), config, PromptSet.of_one(**prompt)
            )
            record_tracking(request, folder, RecordOptions(selection=selection, resume=True))
        assert str(error.value).count(". ") == 0
    (other / "000.png").write_bytes((images / "000.png").read_bytes())
    (other / "005.png").unlink()
    with pytest.raises(InputError, match="number of frames was 6 and is 5"):
        record(open_source(str(other)), settings(), folder, mask=clip.masks[0], resume=True)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_picture_that_has_changed_since_is_refused(clip, images, whole, tmp_path, monkeypatch):
    stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 4)
    other = tmp_path / "other"
    other.mkdir()
    for file in images.iterdir():
        (other / file.name).write_bytes(file.read_bytes())
    write_image(other / "002.png", clip.images[0])
    with pytest.raises(InputError, match=r"002\.png shows another image than when it was estimated"):
        record(open_source(str(other)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert_alike(tmp_path / "run", whole["stand_in"])


def test_frames_that_come_once_only_cannot_be_resumed(clip, tmp_path):
    source = open_source(iter(list(clip.images)))
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    with pytest.raises(InputError, match="cannot be read again from its start"):
        record(
            open_source(iter(list(clip.images))),
            settings(),
            tmp_path / "other",
            mask=clip.masks[0],
            resume=True,
        )


def test_a_run_whose_state_is_gone_is_refused(clip, images, tmp_path, monkeypatch):
    stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 4)
    state = tmp_path / "run" / layout.STATE / layout.STATE_FILE
    kept = state.read_bytes()
    for damage in (kept[:100], b"[]", kept.replace(b'"version": 3', b'"version": 2')):
        state.write_bytes(damage)
        with pytest.raises(InputError, match=r"damaged|another version"):
            record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    state.unlink()
    with pytest.raises(InputError, match="its state was not saved; run it again"):
        record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)


def test_a_run_of_an_earlier_format_is_not_resumed(clip, images, tmp_path, monkeypatch):
    stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 4)
    set_format(tmp_path / "run", 1)
    with pytest.raises(
        InputError, match=r"an earlier version of tracking3d .* run it again with overwrite=True"
    ):
        record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)


def test_nothing_but_json_arrays_and_masks_is_kept_and_no_state_when_the_run_is_finished(
    clip, images, whole, tmp_path, monkeypatch, online
):
    stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 4)
    files = files_of(tmp_path / "run" / layout.STATE)
    assert {file.suffix for file in files} <= {".json", ".jsonl", ".npz", ".png"}
    for file in files:
        if file.suffix == ".npz":
            np.load(tmp_path / "run" / layout.STATE / file, allow_pickle=False).close()
    json.loads((tmp_path / "run" / layout.STATE / layout.STATE_FILE).read_bytes())
    assert not layout.has_state(whole["online"])


def test_a_solver_whose_state_cannot_be_kept_tracks_all_the_same(clip, images, tmp_path, monkeypatch, caplog):
    step, result = CausalSolver.step, StandInSolver.result
    monkeypatch.setattr(
        CausalSolver, "step", lambda self, state, *given: (object(), step(self, 0, *given)[1])
    )
    monkeypatch.setattr(StandInSolver, "result", lambda self, state: result(self, 0))
    config = settings("solver.final_refine=false")
    record(open_source(str(images)), config, tmp_path / "run", mask=clip.masks[0])
    assert RunReader(tmp_path / "run").state == "finished"
    assert sum("cannot be resumed when it is stopped: a object" in text for text in caplog.messages) == 1
    assert not (tmp_path / "run" / layout.STATE).exists()


def test_seconds_do_not_count_the_pause(clip, images, tmp_path, monkeypatch):
    stopped(monkeypatch, clip, images, tmp_path / "run", Session, "step", 3)
    state = tmp_path / "run" / layout.STATE / layout.STATE_FILE
    tree = json.loads(state.read_text())
    tree["progress"]["seconds"] = 1000.0
    state.write_text(json.dumps(tree))
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    timings = RunReader(tmp_path / "run").description["timings"]
    assert timings["passes"]["earlier"] == 1000 < timings["seconds_total"] < 1100


def test_errors_of_the_disk_while_the_state_is_kept_leave_the_one_before(
    clip, images, whole, tmp_path, monkeypatch
):
    stopped(
        monkeypatch, clip, images, tmp_path / "run", Checkpoint, "save", 3, OutputError("The disk is full.")
    )
    assert RunReader(tmp_path / "run").state == "failed"
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert_alike(tmp_path / "run", whole["stand_in"])
