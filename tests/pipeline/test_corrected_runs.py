"""A correction of a run that is there: what depends on it is computed again, from a state that was kept."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_runs import set_format
from refining_solver import CausalSolver, StandInSolver
from resumable_runs import Stopped, assert_alike, files_of, settings

from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.pipeline.correct import correct_run, object_folders_of
from tracking3d.pipeline.record import record, record_objects
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results import layout
from tracking3d.results.checkpoint import folder, staging
from tracking3d.results.checkpoint import folder as checkpoint_folder
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import visible_side
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.video import open_source

FRAMES, CORRECTED = 8, 6


@pytest.fixture(autouse=True)
def every_frame(monkeypatch, stand_in_solver):
    """Rollback points of every frame, and a solver that answers at once."""
    monkeypatch.setattr(folder, "_FIRST_GAP", 1)


@pytest.fixture
def stepped(monkeypatch) -> list[int]:
    """Frames that a session answers for."""
    frames, step = [], Session.step

    def noting(self, frame, *more):
        frames.append(frame.index)
        return step(self, frame, *more)

    monkeypatch.setattr(Session, "step", noting)
    return frames


def run(clip, images, folder: Path, *overrides: str, **given) -> Path:
    """Without evidence, which is weighed again whatever is corrected."""
    given.setdefault("mask", clip.masks[given.get("start_frame") or 0])
    record(open_source(str(images)), settings("object.refine_masks=false", *overrides), folder, **given)
    return folder


def told(clip, frame: int = CORRECTED) -> list[Correction]:
    """A box beside the object, which changes what follows."""
    x, y, width, height = box_of(clip, frame)
    return [Correction(frame, box=(x + 3, y + 2, width, height))]


def box_of(clip, frame: int):
    rows, columns = np.nonzero(clip.masks[frame])
    return (
        float(columns.min()),
        float(rows.min()),
        float(np.ptp(columns) + 1),
        float(np.ptp(rows) + 1),
    )


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: (folder / path).read_bytes() for path in files_of(folder)}


def test_a_corrected_run_in_metres_is_in_metres_again(clip, images, tmp_path):
    prompt = {"mask": clip.masks[0]}
    record(open_source(str(images)), settings("object.size=0.22"), tmp_path / "run", **prompt)
    record(open_source(str(images)), settings(), tmp_path / "whole", **prompt, corrections=told(clip))
    correct_run(tmp_path / "run", told(clip))
    for refined in (True, False):
        run, whole = (RunReader(tmp_path / name, refined) for name in ("run", "whole"))
        assert (run.unit, whole.unit) == ("metre", "arbitrary")
        mesh = load_model(run.mesh_folder)
        assert visible_side(mesh) == pytest.approx(0.22)
        scale = 0.22 / visible_side(load_model(whole.mesh_folder))
        for mine, expected in zip(run.frames, whole.frames, strict=True):
            np.testing.assert_allclose(mine.T_cam_obj[:3, 3], expected.T_cam_obj[:3, 3] * scale, atol=1e-5)


@pytest.mark.parametrize(
    ("solver", "given"),
    [
        (StandInSolver, {}),
        pytest.param(OnlineSolver, {}, marks=pytest.mark.slow),  # the solver itself, three times
        (StandInSolver, {"name": "csrt"}),  # which knows no other way to go on than to see the frames again
    ],
    ids=["memory kept", "online", "frames seen again"],
)
def test_a_finished_run_is_computed_again_from_the_corrected_frame_on(
    clip, images, tmp_path, monkeypatch, stepped, solver, given
):
    monkeypatch.setitem(SOLVERS, "online", solver)
    config = settings(*(f"tracker.{name}={value}" for name, value in given.items()))
    prompt = {"box": box_of(clip, 0)} if given else {"mask": clip.masks[0]}
    record(open_source(str(images)), config, tmp_path / "run", **prompt)
    record(open_source(str(images)), config, tmp_path / "whole", **prompt, corrections=told(clip))
    before = RunReader(tmp_path / "run", refined=False)
    poses = {one.index: one.T_cam_obj for one in before.frames}
    stepped.clear()
    correct_run(tmp_path / "run", told(clip))
    assert stepped == [6, 7]
    after = RunReader(tmp_path / "run", refined=False)
    assert [one["frame"] for one in after.description["prompt"]["corrections"]] == [CORRECTED]
    for one in after.frames[:CORRECTED]:
        np.testing.assert_array_equal(one.T_cam_obj, poses[one.index])
    assert (after.initial_mask(CORRECTED) != RunReader(tmp_path / "run").initial_mask(0)).any()
    assert not (tmp_path / "run" / layout.CORRECTING).exists()
    assert_alike(tmp_path / "run", tmp_path / "whole")


@pytest.mark.slow
def test_corrections_add_up_and_one_of_the_same_frame_replaces_the_earlier(clip, images, tmp_path, stepped):
    run(clip, images, tmp_path / "run")
    correct_run(tmp_path / "run", [Correction(5, mask=clip.masks[5])])
    correct_run(tmp_path / "run", told(clip, 3))
    stepped.clear()
    correct_run(tmp_path / "run", [Correction(5, points=[(40.0, 32.0, 1), (1.0, 1.0, 0)])])
    assert stepped == [5, 6, 7]
    final = [Correction(5, points=[(40.0, 32.0, 1), (1.0, 1.0, 0)]), *told(clip, 3)]
    run(clip, images, tmp_path / "whole", corrections=final)
    assert_alike(tmp_path / "run", tmp_path / "whole")


def test_resume_with_one_more_correction_does_the_same(clip, images, tmp_path, stepped):
    run(clip, images, tmp_path / "run")
    stepped.clear()
    run(clip, images, tmp_path / "run", corrections=told(clip), resume=True)
    assert stepped == [6, 7]
    run(clip, images, tmp_path / "run", corrections=told(clip), resume=True)
    assert stepped == [6, 7]


@pytest.mark.slow
def test_a_run_both_ways_goes_on_in_the_direction_of_the_corrected_frame(clip, images, tmp_path, stepped):
    run(clip, images, tmp_path / "run", start_frame=4)
    stepped.clear()
    correct_run(tmp_path / "run", told(clip, 1))
    assert stepped == [1, 0]
    run(clip, images, tmp_path / "whole", start_frame=4, corrections=told(clip, 1))
    assert_alike(tmp_path / "run", tmp_path / "whole")


@pytest.mark.slow
def test_of_several_objects_one_is_corrected(clip, images, tmp_path):
    boxes = [box_of(clip, 0), (0.0, 0.0, 12.0, 12.0)]
    record_objects(open_source(str(images)), settings(), tmp_path / "run", boxes=boxes)
    first = contents(tmp_path / "run" / "object_0")
    given = [Correction(CORRECTED, mask=clip.masks[CORRECTED], object=1)]
    [(folder, theirs)] = object_folders_of(tmp_path / "run", given).items()
    correct_run(folder, theirs)
    assert (RunReader(folder).initial_mask(CORRECTED) == clip.masks[CORRECTED]).all()
    assert contents(tmp_path / "run" / "object_0") == first
    with pytest.raises(InputError, match="object 2, but there are 2"):
        object_folders_of(tmp_path / "run", [Correction(1, box=boxes[0], object=2)])


@pytest.mark.parametrize("end", [Stopped(), RuntimeError("out of luck")], ids=["stopped", "failed"])
def test_whatever_ends_a_correction_the_run_is_as_it_was_and_the_same_call_goes_on(
    clip, images, tmp_path, monkeypatch, stepped, end
):
    run(clip, images, tmp_path / "run")
    run(clip, images, tmp_path / "whole", corrections=told(clip, 4))
    before = contents(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(CausalSolver, "faults", {6: end})
        with pytest.raises(type(end)):
            correct_run(tmp_path / "run", told(clip, 4))
    after = contents(tmp_path / "run")
    assert {path: data for path, data in after.items() if path.parts[0] != layout.CORRECTING} == before
    stepped.clear()
    correct_run(tmp_path / "run", told(clip, 4))
    assert stepped == [6, 7]
    assert_alike(tmp_path / "run", tmp_path / "whole")


@pytest.mark.slow
def test_another_correction_than_the_one_that_was_stopped_begins_anew(
    clip, images, tmp_path, monkeypatch, stepped
):
    run(clip, images, tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(CausalSolver, "faults", {6: Stopped()})
        with pytest.raises(Stopped):
            correct_run(tmp_path / "run", told(clip, 4))
    stepped.clear()
    correct_run(tmp_path / "run", told(clip, 5))
    assert stepped == [5, 6, 7]
    [one] = RunReader(tmp_path / "run").description["prompt"]["corrections"]
    assert one["frame"] == 5


@pytest.mark.slow
@pytest.mark.parametrize("moves", [0, 1, 5, 20])
def test_a_kill_while_the_copy_takes_its_place_is_made_good(clip, images, tmp_path, monkeypatch, moves):
    run(clip, images, tmp_path / "run")
    run(clip, images, tmp_path / "whole", corrections=told(clip))
    (tmp_path / "run" / "my_notes.txt").write_text("mine")
    move, done = Path.replace, []

    def killed(self, target):
        if layout.CORRECTING in self.parts and layout.CORRECTING not in Path(target).parts:
            done.append(self)
            if len(done) > moves:
                raise Stopped
        return move(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with pytest.raises(Stopped):
            correct_run(tmp_path / "run", told(clip))
    if moves:
        with pytest.raises(InputError, match=r"Only some files of .* are those of its correction"):
            RunReader(tmp_path / "run")
    staging.take_over(tmp_path / "run")
    assert (tmp_path / "run" / "my_notes.txt").read_text() == "mine"
    (tmp_path / "run" / "my_notes.txt").unlink()
    assert_alike(tmp_path / "run", tmp_path / "whole")


def test_two_corrections_at_a_time_are_refused(clip, images, tmp_path):
    run(clip, images, tmp_path / "run")

    def again(frame):
        with pytest.raises(OutputError, match=r"in use|being corrected at this moment"):
            correct_run(tmp_path / "run", told(clip, 5))

    correct_run(tmp_path / "run", told(clip), listener=again)
    assert RunReader(tmp_path / "run").state == "finished"


def test_rollback_points_are_few_and_evenly_spread(clip, images, tmp_path):
    run(clip, images, tmp_path / "run", "runtime.rollback_points=3")
    state = tmp_path / "run" / layout.STATE
    assert [one.taken for one in folder.rollback_points_in(state)] == [4, 8]
    run(clip, images, tmp_path / "none", "runtime.rollback_points=0")
    assert not (tmp_path / "none" / layout.STATE).exists()


def test_nothing_is_kept_that_no_rollback_point_needs(clip, images, tmp_path):
    run(clip, images, tmp_path / "run", "runtime.rollback_points=2")
    state = tmp_path / "run" / layout.STATE
    kept = folder.rollback_points_in(state)
    assert 1 <= len(kept) <= 2
    named = {name for one in kept for name in one.arrays}
    assert {path.name for path in state.glob("*.npz")} == named


@pytest.mark.slow
def test_rollback_points_that_are_too_large_go(clip, images, tmp_path, monkeypatch, caplog, stepped):
    monkeypatch.setattr(checkpoint_folder, "MOST_KEPT", 0)
    run(clip, images, tmp_path / "run")
    assert not (tmp_path / "run" / layout.STATE).exists()
    run(clip, images, tmp_path / "whole", corrections=told(clip))
    stepped.clear()
    correct_run(tmp_path / "run", told(clip))
    assert stepped == list(range(FRAMES))
    assert "No checkpoint before frame 6 is saved" in caplog.text
    assert_alike(tmp_path / "run", tmp_path / "whole")


def test_no_rollback_point_stands_between_a_frame_and_what_revised_it(clip, images, tmp_path, monkeypatch):
    step = CausalSolver.step

    def revising(self, state, frame, mask):
        state, estimate = step(self, state, frame, mask)
        if frame.index == 5:
            estimate = replace(estimate, revised=(replace(estimate, index=2, keyframe=False),))
        return state, estimate

    monkeypatch.setattr(CausalSolver, "step", revising)
    run(clip, images, tmp_path / "run")
    kept = folder.rollback_points_in(tmp_path / "run" / layout.STATE)
    assert [one.taken for one in kept] == [1, 2, 6, 7, 8]


def test_a_damaged_rollback_point_is_passed_over(clip, images, tmp_path, stepped):
    run(clip, images, tmp_path / "run")
    kept = folder.rollback_points_in(tmp_path / "run" / layout.STATE)
    kept[5].path.write_text("{")
    stepped.clear()
    correct_run(tmp_path / "run", told(clip))
    assert stepped == [5, 6, 7]


def test_a_run_of_an_earlier_format_is_not_corrected(clip, images, tmp_path):
    folder = run(clip, images, tmp_path / "run")
    set_format(folder, 1)
    before = contents(folder)
    with pytest.raises(
        InputError, match=r"an earlier version of tracking3d .* run it again with overwrite=True"
    ):
        correct_run(folder, told(clip))
    assert contents(folder) == before


def test_what_cannot_be_corrected_is_refused_in_a_sentence(clip, images, tmp_path):
    folder = run(clip, images, tmp_path / "run")
    before = contents(folder)
    with pytest.raises(InputError, match="frame 99 is not among the tracked frames"):
        correct_run(folder, [Correction(99, box=(1, 1, 5, 5))])
    with pytest.raises(InputError, match="lies outside frame 6"):
        correct_run(folder, [Correction(6, box=(900, 1, 5, 5))])
    assert contents(folder) == before
    shutil.rmtree(folder / layout.PROMPTS)
    with pytest.raises(InputError, match="give it again with `tracking3d run`"):
        correct_run(folder, told(clip))
    description = json.loads((folder / layout.RUN).read_text())
    del description["prompt"]
    (folder / layout.RUN).write_text(json.dumps(description))
    with pytest.raises(InputError, match="names no prompt"):
        correct_run(folder, told(clip))
