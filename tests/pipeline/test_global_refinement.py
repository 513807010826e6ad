"""The final refinement of a file: every frame is estimated again, and the causal estimates stay whole."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from refining_solver import CausalSolver, StandInSolver

from tracking3d import Frame, Session, Status, load_config
from tracking3d.errors import InputError, PluginError
from tracking3d.estimation.estimate import MaskSource
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.paper.solver import PaperSolver
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.frames import SkippedFrame
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS
from tracking3d.plugins.guard import PluginFailure
from tracking3d.results import layout, run_writer
from tracking3d.results.files import write_image
from tracking3d.results.mesh_export import load_model
from tracking3d.results.overlay import OverlaySize
from tracking3d.results.records import FrameRecord, latest
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.results.run_writer import FrameLines
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video import open_source

FRAMES = 5


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES, size=(80, 64)))


@pytest.fixture(autouse=True)
def solvers(monkeypatch):
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)
    monkeypatch.setitem(SOLVERS, "paper", CausalSolver)
    monkeypatch.setattr(CausalSolver, "faults", {})
    monkeypatch.setattr(StandInSolver, "revisit_faults", {})
    monkeypatch.setattr(StandInSolver, "seen", [])


@pytest.fixture
def source(clip, tmp_path):
    folder = tmp_path / "clip"
    folder.mkdir()
    for index, image in enumerate(clip.images):
        write_image(folder / f"{index:03d}.png", image)
    return open_source(str(folder))


def settings(solver: str = "online", refine: bool = True, policy: str = "continue", evidence: bool = False):
    overrides = [
        f"object.refine_masks={str(evidence).lower()}",
        "object.adjustment_views=0",  # stand-ins are judged as they say
        f"solver.name={solver}",
        f"solver.final_refine={str(refine).lower()}",
        "tracker.name=flow",
        "tracker.segmentation_size=64",
    ]
    return load_config(overrides=overrides, runtime={"on_plugin_failure": policy})


def timeless(frame: FrameRecord) -> str:
    """A record without what a clock had to say."""
    return replace(frame, seconds=0.0, stages=None).to_json()


def end_where_refined_lines_are_appended(monkeypatch, error: BaseException) -> None:
    """All masks are in their places then, and no line says so yet."""
    append = FrameLines.append

    def end(self, records) -> None:
        if records[0].refined:
            raise error
        append(self, records)

    monkeypatch.setattr(FrameLines, "append", end)


def refinement_of(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text())["refinement"]


def test_only_a_solver_that_can_look_again_is_a_refining_one(clip):
    for name, can in (("online", True), ("paper", False)):
        session = Session(settings(name), make_prompt(Frame(0, clip.images[0]), mask=clip.masks[0]))
        assert not session.can_refine
        session.step(Frame(0, clip.images[0]))
        assert session.can_refine is can
    assert issubclass(OnlineSolver, RefiningSolver) and not issubclass(PaperSolver, RefiningSolver)


def test_a_session_refines_and_revisits(clip):
    frames = [Frame(n, image) for n, image in enumerate(clip.images)]
    session = Session(settings(), make_prompt(frames[0], mask=clip.masks[0]))
    causal, initial = [], []
    for frame in frames:
        causal.append(session.step(frame))
        initial.append(session.initial_mask)
    with pytest.raises(RuntimeError, match="after refine"):
        session.refine_frame(frames[0], initial[0], causal[0].T_cam_obj)
    before = session.result()
    session.refine()
    for frame, mask, first in zip(frames, initial, causal, strict=True):
        second = session.refine_frame(frame, mask, first.T_cam_obj)
        assert (second.refined, first.refined) == (True, False)
        assert second.T_cam_obj[2, 3] == first.T_cam_obj[2, 3] + 1
        np.testing.assert_array_equal(second.initial_mask, first.initial_mask)
    np.testing.assert_array_equal(session.result().vertices, 2 * before.vertices)
    with pytest.raises(RuntimeError, match="no further step"):
        session.step(frames[-1])


def test_a_session_whose_solver_cannot_refine_says_so(clip):
    session = Session(settings("paper"), make_prompt(Frame(0, clip.images[0]), mask=clip.masks[0]))
    session.step(Frame(0, clip.images[0]))
    with pytest.raises(RuntimeError, match="paper cannot refine"):
        session.refine()


def test_both_answers_of_every_frame_are_kept(clip, source, tmp_path):
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    refined, causal = RunReader(tmp_path / "run"), RunReader(tmp_path / "run", refined=False)
    assert refined.state == "finished"
    assert (
        [frame.index for frame in refined.frames]
        == [frame.index for frame in causal.frames]
        == [0, 1, 2, 3, 4]
    )
    for final, first in zip(refined.frames, causal.frames, strict=True):
        assert (final.refined, final.revision, final.status) == (True, True, Status.TRACKED)
        assert (first.refined, first.revision, first.status) == (False, False, Status.UNCERTAIN)
        assert first.T_cam_obj[2, 3] == 3
        assert final.T_cam_obj[2, 3] == 4
        assert final.name == first.name == f"{final.index:03d}.png"
        assert final.keyframe == first.keyframe == (final.index % 2 == 0)
        assert final.hypothesis == first.hypothesis == "last pose"
        assert final.iou_initial == 1 > first.iou_initial
        initial = refined.initial_mask(final.index)
        np.testing.assert_array_equal(refined.mask(final.index), initial)
        np.testing.assert_array_equal(causal.mask(final.index), np.roll(initial, 1, axis=0))
    lines = list(read_records(tmp_path / "run" / "frames.jsonl"))
    assert [line.refined for line in lines] == [False] * FRAMES + [True] * FRAMES
    assert [record_.refined for record_ in latest(lines)] == [True] * FRAMES
    assert [record_.refined for record_ in latest(lines, refined=False)] == [False] * FRAMES
    # The mesh that belongs to either.
    np.testing.assert_allclose(refined.mesh().vertices, 2 * causal.mesh().vertices, atol=1e-6)
    sizes = [np.ptp(load_model(run.mesh_folder).vertices) for run in (refined, causal)]
    assert sizes == [4, 2]


def test_masks_are_weighed_once_more_and_the_causal_ones_stand(clip, source, tmp_path):
    record(source, settings(evidence=True), tmp_path / "run", mask=clip.masks[0])
    final, causal = RunReader(tmp_path / "run"), RunReader(tmp_path / "run", refined=False)
    for frame, before in zip(final.frames, causal.frames, strict=True):
        mask = final.mask(frame.index)
        assert frame.area == np.count_nonzero(mask)
        assert before.mask_source is not MaskSource.FUSED
        assert before.area == np.count_nonzero(causal.mask(frame.index))
    assert any(frame.mask_source is MaskSource.FUSED for frame in final.frames)
    assert final.config["object"]["refine_masks"]


def test_the_mask_tracker_runs_once_and_its_masks_come_again_as_they_were(
    clip, source, tmp_path, monkeypatch
):
    given: list[int] = []
    step = CausalSolver.step

    def counted(self, state, frame, mask):
        given.append(mask)
        return step(self, state, frame, mask)

    monkeypatch.setattr(CausalSolver, "step", counted)
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    assert [index for index, _ in StandInSolver.seen] == list(range(FRAMES))
    for first, (_, second) in zip(given, StandInSolver.seen[1:], strict=True):
        np.testing.assert_array_equal(first.binary, second.binary)
        assert (first.score, first.reason) == (second.score, second.reason)
        assert second.mask.dtype == np.float32


def test_run_json_tells_counts_and_seconds_of_the_refinement(clip, source, tmp_path):
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    told = refinement_of(tmp_path / "run")
    assert (told["state"], told["reason"], told["frames"], told["kept_causal"]) == ("finished", "", FRAMES, 0)
    assert told["seconds"] > 0
    causal = told["causal"]
    assert (causal["tracked"], causal["uncertain"], causal["lost"]) == (0, FRAMES, 0)
    assert 0.5 < causal["iou_initial_mean"] < 1
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    assert run["counts"]["tracked"] == FRAMES
    assert run["counts"]["keyframes"] == 3
    assert run["iou_initial_mean"] == 1
    assert run["timings"]["seconds_per_frame_mean"] == pytest.approx(
        sum(run["timings"]["stages"].values()) / 5
    )


@pytest.mark.usefixtures("as_users_see_it")
def test_the_overlay_is_drawn_again(clip, source, tmp_path):
    """The bar below the picture names the status in its colour: yellow before, green after."""
    greens = {}
    for refine in (False, True):
        folder = tmp_path / f"run_{refine}"
        record(source, settings(refine=refine), folder, mask=clip.masks[0])
        with av.open(str(folder / "overlay.mp4")) as video:
            pictures = [picture.to_ndarray(format="rgb24") for picture in video.decode(video=0)]
        assert len(pictures) == FRAMES
        below = OverlaySize.of(RunReader(folder).camera).picture
        bar = pictures[2][below:, :120].reshape(-1, 3).astype(int)
        greens[refine] = (bar[:, 1] - bar[:, 0]).max()
    assert greens[True] > 60 > greens[False]
    assert not (tmp_path / "run_True" / layout.REFINING).exists()


def test_nothing_is_refined_unless_asked_for(clip, source, tmp_path):
    record(source, settings(refine=False), tmp_path / "run", mask=clip.masks[0])
    assert refinement_of(tmp_path / "run") is None
    assert not (tmp_path / "run" / layout.CAUSAL).exists()
    assert [frame.refined for frame in RunReader(tmp_path / "run").frames] == [False] * FRAMES


def test_a_solver_that_cannot_leaves_it_out_and_says_so(clip, source, tmp_path):
    record(source, settings("paper"), tmp_path / "run", mask=clip.masks[0])
    told = refinement_of(tmp_path / "run")
    assert (told["state"], told["reason"]) == ("skipped", "the solver paper gives causal estimates only")
    assert RunReader(tmp_path / "run").state == "finished"


def test_frames_that_come_once_only_are_not_refined(clip, tmp_path):
    record(open_source(iter(list(clip.images))), settings(), tmp_path / "run", mask=clip.masks[0])
    told = refinement_of(tmp_path / "run")
    assert (told["state"], told["frames"]) == ("skipped", 0)
    assert "cannot be read a second time" in told["reason"]
    assert [frame.refined for frame in RunReader(tmp_path / "run").frames] == [False] * FRAMES


def test_arrays_that_can_be_gone_through_again_are_refined(clip, tmp_path):
    record(open_source(clip.images), settings(), tmp_path / "run", mask=clip.masks[0])
    assert refinement_of(tmp_path / "run")["frames"] == FRAMES


def test_a_frame_that_could_not_be_read_is_not_looked_at_again(clip, source, tmp_path):
    source.files[2].write_bytes(b"no image")
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    assert [index for index, _ in StandInSolver.seen] == [0, 1, 3, 4]
    assert [frame.index for frame in RunReader(tmp_path / "run").frames] == [0, 1, 3, 4]


def test_a_frame_that_can_be_read_the_second_time_only_is_passed_over(clip, source, tmp_path, monkeypatch):
    source.files[2].write_bytes(b"no image")
    refine = StandInSolver.refine

    def mend(self, state):
        write_image(source.files[2], clip.images[2])
        return refine(self, state)

    monkeypatch.setattr(StandInSolver, "refine", mend)
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    assert [index for index, _ in StandInSolver.seen] == [0, 1, 3, 4]
    assert [frame.index for frame in RunReader(tmp_path / "run").frames] == [0, 1, 3, 4]


@pytest.mark.parametrize(
    ("where", "error", "state"),
    [
        ("solve", KeyboardInterrupt(), "interrupted"),
        ("frame", KeyboardInterrupt(), "interrupted"),
        ("take over", KeyboardInterrupt(), "interrupted"),
        ("frame", InputError("The solver gave up."), "failed"),
        ("frame", ZeroDivisionError("division by zero"), "failed"),
    ],
)
def test_what_ends_the_refinement_leaves_the_causal_answers_whole(
    clip, source, tmp_path, monkeypatch, where, error, state
):
    reference = tmp_path / "reference"
    record(source, settings(refine=False), reference, mask=clip.masks[0])

    def end(*_):
        raise error

    if where == "solve":
        monkeypatch.setattr(StandInSolver, "refine", end)
    elif where == "frame":
        monkeypatch.setattr(StandInSolver, "revisit_faults", {3: error})
    else:
        end_where_refined_lines_are_appended(monkeypatch, error)
    with pytest.raises(type(error)) as caught:
        record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    [note] = caught.value.__notes__
    assert note == (
        f"The final refinement was not finished; the causal estimates are whole in {tmp_path / 'run'}."
    )
    for refined in (True, False):
        run, expected = RunReader(tmp_path / "run", refined), RunReader(reference)
        assert run.state == state
        assert [timeless(frame) for frame in run.frames] == [timeless(frame) for frame in expected.frames]
        for index in range(FRAMES):
            np.testing.assert_array_equal(run.mask(index), expected.mask(index))
        np.testing.assert_array_equal(run.mesh().vertices, expected.mesh().vertices)
    told = refinement_of(tmp_path / "run")
    assert (told["state"], told["frames"], told["kept_causal"]) == (state, 0, FRAMES)
    files = {path.relative_to(tmp_path / "run") for path in (tmp_path / "run").rglob("*")}
    # What the run can be resumed from is kept beside the answers.
    there = {path.relative_to(reference) for path in reference.rglob("*")}
    of_state = {path for path in files | there if path.parts[0] in (layout.STATE, layout.REFINING)}
    assert files - of_state == there - of_state
    with av.open(str(tmp_path / "run" / "overlay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == FRAMES


def test_an_error_before_the_refinement_is_told_as_ever(clip, source, tmp_path, monkeypatch):
    monkeypatch.setattr(CausalSolver, "faults", {2: KeyboardInterrupt()})
    with pytest.raises(KeyboardInterrupt) as caught:
        record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    assert caught.value.__notes__ == [f"The frames finished until then are in {tmp_path / 'run'}."]
    assert refinement_of(tmp_path / "run") is None


def test_where_a_plugin_fails_the_causal_answer_stands(clip, source, tmp_path, monkeypatch):
    failure = PluginFailure("feature encoder 'bad'", "no channels")
    monkeypatch.setattr(StandInSolver, "revisit_faults", {2: failure})
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    run = RunReader(tmp_path / "run")
    assert run.state == "finished"
    assert [frame.refined for frame in run.frames] == [True, True, False, True, True]
    told = refinement_of(tmp_path / "run")
    assert (told["frames"], told["kept_causal"]) == (4, 1)
    for reader in (run, RunReader(tmp_path / "run", refined=False)):
        np.testing.assert_array_equal(reader.mask(2), np.roll(reader.initial_mask(2), 1, axis=0))
    with pytest.raises(PluginError, match=r"failed at 002\.png"):
        record(source, settings(policy="stop"), tmp_path / "other", mask=clip.masks[0])


def test_a_refined_run_is_replaced_without_a_trace(clip, source, tmp_path):
    record(source, settings(), tmp_path / "run", mask=clip.masks[0])
    record(source, settings(refine=False), tmp_path / "run", mask=clip.masks[0], overwrite=True)
    assert not list((tmp_path / "run" / layout.CAUSAL).rglob("*.*"))
    assert [frame.refined for frame in RunReader(tmp_path / "run").frames] == [False] * FRAMES


def test_a_kill_while_masks_are_taken_over_leaves_the_causal_answers(clip, source, tmp_path, monkeypatch):
    """As the folder is between the moves and the lines: readers go by the lines."""
    folder = tmp_path / "run"
    monkeypatch.setattr(run_writer.RunWriter, "finish", lambda self, *_: self._lines.close())
    end_where_refined_lines_are_appended(monkeypatch, SystemExit())
    with pytest.raises(SystemExit):
        record(source, settings(), folder, mask=clip.masks[0])
    run = RunReader(folder)
    assert [frame.refined for frame in run.frames] == [False] * FRAMES
    for index in range(FRAMES):
        np.testing.assert_array_equal(run.mask(index), np.roll(run.initial_mask(index), 1, axis=0))
    assert np.ptp(run.mesh().vertices) == pytest.approx(2)


def test_the_listener_hears_of_every_frame_twice(clip, source, tmp_path):
    told: list = []
    source.files[1].write_bytes(b"no image")
    record(source, settings(), tmp_path / "run", mask=clip.masks[0], listener=told.append)
    first, second = told[:FRAMES], told[FRAMES:]
    assert [frame.index for frame in first] == [0, 1, 2, 3, 4]
    assert isinstance(first[1], SkippedFrame)
    assert [(frame.index, frame.refined) for frame in second] == [(n, True) for n in (0, 2, 3, 4)]
