"""A correction keeps what a run's model was made with, leaves nothing stale, and says before what it replaces."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from refining_solver import StandInSolver

from tracking3d import load_config
from tracking3d.errors import InputError
from tracking3d.pipeline import correct
from tracking3d.pipeline.correct import correct_run, replaced_by_correction
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.reconstruction import rebuild
from tracking3d.results import layout
from tracking3d.results.checkpoint import folder
from tracking3d.results.checkpoint.staging import take_over
from tracking3d.results.files import write_image
from tracking3d.results.mesh_export import export_mesh, load_model
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.video import open_source

FRAMES = 4
GIVEN = [Correction(3, box=(20.0, 16.0, 40.0, 32.0))]


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES, size=(80, 64), supersample=1, degrees_per_frame=4))


@pytest.fixture(autouse=True)
def quick_solver(monkeypatch):
    monkeypatch.setattr(folder, "_FIRST_GAP", 1)
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)
    monkeypatch.setattr(correct, "check_packages", lambda: None)


@pytest.fixture
def run(clip, tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    for index, image in enumerate(clip.images):
        write_image(tmp_path / "clip" / f"{index:03d}.png", image)
    quick = [
        "tracker.name=flow",
        "tracker.segmentation_size=64",
        "crop.size=32",
        "object.frequency=2",
        "camera.fov=45",
    ]
    config = load_config(overrides=[*quick, "object.adjustment_views=0", "object.refine_masks=false"])
    record(open_source(str(tmp_path / "clip")), config, tmp_path / "run", mask=clip.masks[0])
    return tmp_path / "run"


@pytest.fixture
def rebuilt(run, monkeypatch) -> list[Path]:
    """The run as `tracking3d model --quality fine` leaves it; the folders whose shape is reconstructed from then on."""
    folders = []

    def reconstruct(folder: Path, source, *limits: int) -> SimpleNamespace:
        folders.append(folder)
        (folder / layout.ONLINE).mkdir(exist_ok=True)
        for into in (folder / layout.ONLINE, folder):
            export_mesh(into, load_model(folder))
        return SimpleNamespace(sentence="A new shape.")

    monkeypatch.setattr(rebuild, "rebuild_shape", reconstruct)
    reconstruct(run, None)
    folders.clear()
    return folders


def test_a_reconstructed_shape_is_reconstructed_again_before_the_run_is_replaced(run, rebuilt):
    assert any("is reconstructed again" in sentence for sentence in replaced_by_correction(run))
    correct_run(run, GIVEN)
    assert rebuilt == [run / layout.CORRECTING]
    assert (run / layout.ONLINE / layout.FEATURES).is_file()
    assert RunReader(run).description["shape"] == "A new shape."
    assert not (run / layout.CORRECTING).exists()


def test_a_shape_that_hardly_any_frame_contradicts_stays(run, rebuilt, monkeypatch):
    note_in_run(run, {"shape": "Better."})
    monkeypatch.setattr(rebuild, "_MOST_CHANGED", 1.0)
    before = load_model(run)
    correct_run(run, GIVEN)
    assert rebuilt == []
    assert RunReader(run).description["shape"] == "Better."
    np.testing.assert_allclose(load_model(run).vertices, before.vertices)
    assert (run / layout.ONLINE / layout.FEATURES).is_file()


def test_a_mask_that_is_missing_in_the_run_before_costs_no_more_than_a_new_shape(run, rebuilt, monkeypatch):
    def missing(*given: Path) -> bool:
        raise FileNotFoundError("000003.png")

    monkeypatch.setattr(rebuild, "keep_shape", missing)
    correct_run(run, GIVEN)
    assert rebuilt == [run / layout.CORRECTING]


def test_until_the_shape_is_there_the_run_stays_and_the_same_call_makes_only_that(run, rebuilt, monkeypatch):
    before = (run / layout.FRAMES).read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(rebuild, "rebuild_shape", lambda *given: (_ for _ in ()).throw(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            correct_run(run, GIVEN)
    take_over(run)  # as whatever comes next does
    assert (run / layout.FRAMES).read_bytes() == before
    assert (run / layout.ONLINE / layout.FEATURES).is_file()
    monkeypatch.setattr(Session, "step", lambda *given: pytest.fail("all frames are estimated"))
    correct_run(run, GIVEN)
    assert rebuilt == [run / layout.CORRECTING]
    assert [one["frame"] for one in RunReader(run).description["prompt"]["corrections"]] == [3]


def test_without_the_packages_for_its_shape_a_run_is_not_corrected(run, rebuilt, monkeypatch):
    def missing() -> None:
        raise InputError("A new shape needs xatlas.")

    monkeypatch.setattr(correct, "check_packages", missing)
    with pytest.raises(InputError, match="needs xatlas"):
        correct_run(run, GIVEN)
    assert not (run / layout.CORRECTING).exists()


def test_a_run_whose_shape_was_not_reconstructed_gets_none_and_no_empty_folder(run, rebuilt):
    for file in (run / layout.ONLINE).iterdir():
        file.unlink()
    (run / layout.ONLINE).rmdir()
    assert replaced_by_correction(run) == []
    correct_run(run, GIVEN)
    assert rebuilt == []
    assert not [path for path in run.rglob("*") if path.is_dir() and not any(path.iterdir())]


def test_exports_of_the_earlier_run_are_set_aside_and_none_is_lost(run):
    for count in (1, 2):
        (run / "export").mkdir()
        (run / "export" / "run.usdz").write_text(f"as it was, {count}")
        assert any("becomes export_before_correction" in sentence for sentence in replaced_by_correction(run))
        correct_run(run, [Correction(3, box=(20.0 + count, 16.0, 40.0, 32.0))])
        assert not (run / "export").exists()
    kept = [run / name / "run.usdz" for name in ("export_before_correction", "export_before_correction_2")]
    assert [path.read_text() for path in kept] == ["as it was, 1", "as it was, 2"]


def test_landmarks_and_a_report_that_is_not_written_again_are_announced(run):
    (run / layout.LANDMARKS).write_bytes(b"")
    (run / layout.REPORT).write_text("")
    said = " ".join(replaced_by_correction(run, report=False))
    assert "landmarks.npz is removed" in said
    assert "The report of" in said
    assert "The report of" not in " ".join(replaced_by_correction(run, report=True))
    correct_run(run, GIVEN)
    assert not (run / layout.LANDMARKS).exists()
