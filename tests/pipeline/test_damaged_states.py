"""Runs whose files are damaged go back to what is whole, and end as a run that nobody disturbed."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from refining_solver import StandInSolver
from resumable_runs import Stopped, assert_alike, settings, stop_at

from tracking3d.errors import InputError
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_writer import RunWriter
from tracking3d.video import open_source

FRAMES = 7
STATE = Path(layout.STATE, layout.STATE_FILE)


class SteadySolver(StandInSolver):
    """Its second estimates depend on how many came before: a state of another frame gives others."""

    def refine_frame(self, state, frame, mask, T_cam_obj):
        state, estimate = super().refine_frame(state, frame, mask, T_cam_obj)
        T = estimate.T_cam_obj.copy()
        T[1, 3] = state
        return state, replace(estimate, T_cam_obj=T)


@pytest.fixture(autouse=True)
def steady_solver(monkeypatch, stand_in_solver):
    monkeypatch.setitem(SOLVERS, "online", SteadySolver)


@pytest.fixture(scope="module")
def runs(clip, images, tmp_path_factory) -> dict[str, Path]:
    """One run that nobody stopped, and others that were stopped."""
    folder = tmp_path_factory.mktemp("runs")
    moments = {
        "tracking": (Session, "step", 6),
        "refining": (Session, "refine_frame", 5),
        "ending": (RunWriter, "_finish", 0),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SOLVERS, "online", SteadySolver)
        record(open_source(str(images)), settings(), folder / "whole", mask=clip.masks[0])
        for name, moment in moments.items():
            with pytest.MonkeyPatch.context() as inner:
                stop_at(inner, *moment)
                with pytest.raises(Stopped):
                    record(open_source(str(images)), settings(), folder / name, mask=clip.masks[0])
    return {path.name: path for path in folder.iterdir()}


@pytest.fixture
def resume(clip, images, monkeypatch, caplog) -> Callable[[Path], tuple[list[tuple[str, int]], list[str]]]:
    """Resume a run; gives the estimates that were made, and what was said."""

    def resume(folder: Path) -> tuple[list[tuple[str, int]], list[str]]:
        made: list[tuple[str, int]] = []
        caplog.clear()
        with monkeypatch.context() as patch, caplog.at_level(logging.WARNING, "tracking3d"):
            for name in ("step", "refine_frame"):
                method = getattr(Session, name)

                def noting(self, frame, *given, method=method, name=name):
                    made.append((name, frame.index))
                    return method(self, frame, *given)

                patch.setattr(Session, name, noting)
            record(open_source(str(images)), settings(), folder, mask=clip.masks[0], resume=True)
        return made, caplog.messages

    return resume


def lines_of(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


def cut(path: Path, lines: int, torn: int = 0, nul: int = 0) -> None:
    """Leave some lines, a torn part of the next, and NUL bytes."""
    whole = lines_of(path)
    rest = whole[lines][:torn] if torn else b""
    path.write_bytes(b"".join(whole[:lines]) + rest + b"\0" * nul)


def zeros(path: Path) -> None:
    path.write_bytes(b"\0" * path.stat().st_size)


def half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def another(path: Path) -> None:
    """The mask of something else."""
    shutil.copyfile(path.with_name("000000.png"), path)
    mask = read_mask(path)
    assert mask is not None
    write_image(path, np.zeros(mask.shape, np.uint8))


MASK_DAMAGES = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "one byte": lambda path: path.write_bytes(b"\x89"),
    "torn": half,
    "zeros": zeros,
    "no image": lambda path: path.write_bytes(b"no image"),
    "of another": another,
}
LINE_DAMAGES = {
    "shorter by a line": lambda path, count: cut(path, count - 1),
    "torn": lambda path, count: cut(path, count - 1, torn=40),
    "without its last newline": lambda path, count: path.write_bytes(path.read_bytes()[:-1]),
    "NUL bytes in place of a line": lambda path, count: cut(path, count - 1, nul=5000),
    "a torn line and NUL bytes": lambda path, count: cut(path, count - 2, torn=20, nul=300),
    "empty": lambda path, count: path.write_bytes(b""),
    "missing": lambda path, count: path.unlink(),
    "NUL bytes in the middle": lambda path, count: path.write_bytes(
        path.read_bytes().replace(b'"index": 1,', b"\0" * 11)
    ),
}


def steps(start: int = 0) -> list[tuple[str, int]]:
    return [("step", n) for n in range(start, FRAMES)] + refinements()


def refinements(start: int = 0) -> list[tuple[str, int]]:
    return [("refine_frame", n) for n in range(start, FRAMES)]


def test_runs_that_are_whole_go_on_from_their_last_frame_and_nothing_is_said(runs, tmp_path, resume):
    for name, expected in {"tracking": steps(6), "refining": refinements(5), "ending": []}.items():
        folder = shutil.copytree(runs[name], tmp_path / name)
        assert resume(folder) == (expected, [])
        assert_alike(folder, runs["whole"])


@pytest.mark.parametrize("damage", LINE_DAMAGES)
def test_lines_that_are_lost_are_estimated_again(runs, tmp_path, resume, damage):
    folder = shutil.copytree(runs["tracking"], tmp_path / "run")
    LINE_DAMAGES[damage](folder / layout.FRAMES, 6)
    made, said = resume(folder)
    # The state of frame 3 is saved as a rollback point: that is the last one that is whole, if its line is.
    early = damage in ("empty", "missing", "NUL bytes in the middle")
    assert made == steps(0 if early else 4)
    [sentence] = said
    assert layout.FRAMES in sentence and str(folder) in sentence
    assert ("the run begins again" if early else "goes on after frame 3") in sentence
    assert_alike(folder, runs["whole"])


def test_lines_that_are_longer_than_the_state_says_are_of_a_kill_and_no_damage(runs, tmp_path, resume):
    folder = shutil.copytree(runs["tracking"], tmp_path / "run")
    with (folder / layout.FRAMES).open("ab") as file:
        file.write(b'{"index": 6, "ti')
    assert resume(folder) == (steps(6), [])
    assert_alike(folder, runs["whole"])


@pytest.mark.parametrize("kind", [layout.MASKS, layout.INITIAL_MASKS])
@pytest.mark.parametrize("damage", MASK_DAMAGES)
def test_a_frame_whose_mask_is_lost_is_estimated_again(runs, tmp_path, resume, damage, kind):
    if kind == layout.INITIAL_MASKS and damage == "of another":
        pytest.skip("nothing says what the mask tracker's mask was")
    folder = shutil.copytree(runs["tracking"], tmp_path / "run")
    MASK_DAMAGES[damage](folder / kind / "000004.png")
    made, [sentence] = resume(folder)
    assert made == steps(4)
    assert f"{kind}/000004.png is missing or damaged; the run goes on after frame 3" in sentence
    assert_alike(folder, runs["whole"])


def test_a_frame_before_all_saved_states_lets_the_run_restart_without_points(runs, tmp_path, resume):
    folder = shutil.copytree(runs["tracking"], tmp_path / "run")
    (folder / layout.MASKS / "000002.png").unlink()
    made, [sentence] = resume(folder)
    assert made == steps()
    assert "masks/000002.png is missing or damaged, and no state from before" in sentence
    assert_alike(folder, runs["whole"])


@pytest.mark.parametrize(
    ("moment", "damage"),
    [
        *(("refining", f"lines {name}") for name in LINE_DAMAGES),
        *(("refining", f"mask {name}") for name in ("missing", "torn", "of another")),
        ("ending", "lines torn"),
        ("ending", "mask missing"),
        ("ending", "mask empty"),
    ],
)
def test_a_refinement_that_is_damaged_begins_again(runs, tmp_path, resume, damage, moment):
    folder = shutil.copytree(runs[moment], tmp_path / "run")
    what, _, how = damage.partition(" ")
    aside = folder / layout.REFINING
    if what == "mask":
        MASK_DAMAGES[how](aside / layout.MASKS / "000003.png")
    else:
        LINE_DAMAGES[how](aside / layout.FRAMES, len(lines_of(aside / layout.FRAMES)))
    made, [sentence] = resume(folder)
    assert made == refinements()
    assert "masks/000003.png" in sentence or f"{layout.REFINING}/{layout.FRAMES}" in sentence
    assert sentence.endswith("the final refinement begins again.")
    assert_alike(folder, runs["whole"])


@pytest.mark.parametrize("moment", ["refining", "ending"])
def test_a_causal_estimate_that_is_damaged_is_made_again_before_the_refinement(
    runs, tmp_path, resume, moment
):
    folder = shutil.copytree(runs[moment], tmp_path / "run")
    causal = folder / (layout.CAUSAL if moment == "ending" else "")
    (causal / layout.MASKS / "000005.png").write_bytes(b"")
    made, [sentence] = resume(folder)
    assert made == steps(4)
    assert "the run goes on after frame 3" in sentence
    assert_alike(folder, runs["whole"])


@pytest.mark.parametrize(
    "damage", [half, zeros, lambda path: path.write_bytes(b"")], ids=["torn", "zeros", "empty"]
)
@pytest.mark.parametrize("name", [layout.STATE_FILE, layout.JOURNAL])
def test_a_state_that_is_damaged_gives_way_to_the_one_before(runs, tmp_path, resume, damage, name):
    folder = shutil.copytree(runs["tracking"], tmp_path / "run")
    path = folder / layout.STATE / name
    if name == layout.JOURNAL and damage is not half:
        kept = lines_of(path)
        path.write_bytes(b"".join(kept[:4]) + b"\0" * len(b"".join(kept[4:])))
    elif name == layout.JOURNAL:
        path.write_bytes(b"".join(lines_of(path)[:5]))
    else:
        damage(path)
    made, [sentence] = resume(folder)
    assert made == steps(4)
    assert "state.json is damaged; the run goes on after frame 3" in sentence
    assert_alike(folder, runs["whole"])


def test_a_run_without_any_state_that_is_whole_is_refused_and_left_as_it_is(runs, tmp_path, resume):
    folder = shutil.copytree(runs["tracking"], tmp_path / "run")
    for path in folder.glob(f"{layout.STATE}/*.json"):
        half(path)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"state\.json is damaged"):
        resume(folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_run_that_was_damaged_can_be_damaged_again(runs, tmp_path, resume, clip, images, monkeypatch):
    folder = shutil.copytree(runs["refining"], tmp_path / "run")
    (folder / layout.MASKS / "000005.png").unlink()
    with monkeypatch.context() as patch:
        stop_at(patch, Session, "step", 2)
        with pytest.raises(Stopped):
            record(open_source(str(images)), settings(), folder, mask=clip.masks[0], resume=True)
    cut(folder / layout.FRAMES, 5)
    made, _ = resume(folder)
    assert made == steps(4)
    assert_alike(folder, runs["whole"])
    assert [one["frames"] for one in RunReader(folder).description["resumed"]] == [4, 4]


def test_a_damaged_run_can_be_overwritten(runs, tmp_path, clip, images):
    folder = shutil.copytree(runs["whole"], tmp_path / "run")
    cut(folder / layout.FRAMES, 2, nul=100)
    record(open_source(str(images)), settings(), folder, mask=clip.masks[0], overwrite=True)
    assert_alike(folder, runs["whole"])


FINISHED_DAMAGES: dict[str, Callable[[Path], object]] = {
    "a refined mask": lambda folder: (folder / layout.MASKS / "000005.png").unlink(),
    "a causal mask": lambda folder: zeros(folder / layout.CAUSAL / layout.MASKS / "000005.png"),
    "an initial mask": lambda folder: (folder / layout.INITIAL_MASKS / "000005.png").write_bytes(b"x"),
    "a refined line": lambda folder: cut(folder / layout.FRAMES, 2 * FRAMES - 1),
    "a torn line": lambda folder: cut(folder / layout.FRAMES, 2 * FRAMES - 1, torn=30),
    "causal lines": lambda folder: cut(folder / layout.FRAMES, FRAMES - 2, nul=900),
    "the exact model": lambda folder: half(folder / layout.FEATURES),
    "a mask before all states": lambda folder: (folder / layout.MASKS / "000001.png").unlink(),
}


@pytest.mark.parametrize("damage", FINISHED_DAMAGES)
def test_a_finished_run_that_is_damaged_is_made_again_in_a_copy(
    runs, tmp_path, resume, clip, images, monkeypatch, damage
):
    folder = shutil.copytree(runs["whole"], tmp_path / "run")
    FINISHED_DAMAGES[damage](folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with monkeypatch.context() as patch:
        stop_at(patch, Session, "refine_frame", 2)
        with pytest.raises(Stopped):
            record(open_source(str(images)), settings(), folder, mask=clip.masks[0], resume=True)
    assert {path: path.read_bytes() for path in before} == before, "until the end the run is as it was"
    made, said = resume(folder)
    assert made == refinements(2)
    assert any("what depends on it is computed again" in sentence for sentence in said)
    assert_alike(folder, runs["whole"])
    assert not (folder / layout.CORRECTING).exists()


@pytest.mark.parametrize("name", [*layout.MESH_FILES[:4], layout.OVERLAY, layout.CONTACT_SHEET])
@pytest.mark.parametrize(
    "damage", [Path.unlink, lambda path: path.write_bytes(b"")], ids=["missing", "empty"]
)
def test_a_finished_run_whose_artefact_is_missing_gets_that_alone(runs, tmp_path, resume, name, damage):
    folder = shutil.copytree(runs["whole"], tmp_path / "run")
    others = {
        path: path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name not in (*layout.MESH_FILES, name, layout.CONTACT_SHEET)
    }
    damage(folder / name)
    made, [sentence] = resume(folder)
    assert made == [] and name in sentence
    if name in (layout.OVERLAY, layout.CONTACT_SHEET):
        assert frames_of(folder) == frames_of(runs["whole"])
        assert (folder / layout.CONTACT_SHEET).stat().st_size > 1000
    else:
        assert (folder / name).read_bytes() == (runs["whole"] / name).read_bytes()
    assert {path: path.read_bytes() for path in others} == others
    assert resume(folder) == ([], [])


def frames_of(folder: Path) -> list[bytes]:
    with av.open(str(folder / layout.OVERLAY)) as video:
        return [frame.to_ndarray(format="rgb24").tobytes() for frame in video.decode(video=0)]


def test_the_state_at_the_start_of_the_refinement_is_gone_when_the_run_is_finished(runs):
    start = Path(layout.STATE, layout.REFINEMENT_START)
    assert (runs["refining"] / start).is_file()
    assert not (runs["whole"] / start).exists()
    needed = json.loads((runs["refining"] / start).read_bytes())["progress"]
    assert needed["refining"] and needed["last_refined"] == -1


def test_a_mask_that_was_fed_back_to_the_tracker_has_to_be_whole(
    runs, tmp_path, resume, clip, images, monkeypatch
):
    monkeypatch.setattr("tracking3d.pipeline.session.corrects", lambda estimate: estimate.index == 4)
    folder, config = tmp_path / "run", settings("solver.tracker_feedback=true")
    record(open_source(str(images)), config, tmp_path / "whole", mask=clip.masks[0])
    with monkeypatch.context() as patch:
        stop_at(patch, Session, "step", 6)
        with pytest.raises(Stopped):
            record(open_source(str(images)), config, folder, mask=clip.masks[0])
    (folder / layout.STATE / layout.MASKS / "000004.png").unlink()
    record(open_source(str(images)), config, folder, mask=clip.masks[0], resume=True)
    assert_alike(folder, tmp_path / "whole")


def test_a_shape_that_was_interrupted_is_reconstructed_when_the_run_is_resumed(
    tmp_path, clip, images, monkeypatch
):
    def stop(*_):
        raise Stopped

    folder, config = tmp_path / "run", settings("object.shape=fine")
    with monkeypatch.context() as patch, pytest.raises(Stopped):
        patch.setattr("tracking3d.reconstruction.rebuild.rebuild_shape", stop)
        record(open_source(str(images)), config, folder, mask=clip.masks[0])
    assert RunReader(folder).state == "finished" and "shape" not in RunReader(folder).description
    record(open_source(str(images)), config, folder, mask=clip.masks[0], resume=True)
    assert RunReader(folder).description["shape"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moment", "file"),
    [
        ((Session, "step", 6), layout.FRAMES),
        ((Session, "refine_frame", 5), f"{layout.REFINING}/{layout.FRAMES}"),
    ],
    ids=["tracked", "refined"],
)
def test_the_online_solver_goes_back_to_the_same_estimates(tmp_path, clip, images, monkeypatch, moment, file):
    monkeypatch.setitem(SOLVERS, "online", OnlineSolver)
    record(open_source(str(images)), settings(), tmp_path / "whole", mask=clip.masks[0])
    with monkeypatch.context() as patch, pytest.raises(Stopped):
        stop_at(patch, *moment)
        record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0])
    cut(tmp_path / "run" / file, len(lines_of(tmp_path / "run" / file)) - 1, nul=500)
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0], resume=True)
    assert_alike(tmp_path / "run", tmp_path / "whole")
