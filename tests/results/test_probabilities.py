"""The object's probability beside the masks: of the final answers, where it was asked for, and nowhere else."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "pipeline"))  # refining_solver

from refining_solver import CausalSolver, StandInSolver

from tracking3d import load_config
from tracking3d.pipeline.correct import correct_run
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS
from tracking3d.results import layout
from tracking3d.results.files import read_probability, write_image, write_probability
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.video import open_source

FRAMES = 3


@pytest.fixture
def clip(tmp_path):
    clip = synthesize(SyntheticSpec(frames=FRAMES, size=(64, 48), supersample=1, degrees_per_frame=4))
    for index, image in enumerate(clip.images):
        (tmp_path / "clip").mkdir(exist_ok=True)
        write_image(tmp_path / "clip" / f"{index:03d}.png", image)
    return clip


@pytest.fixture(autouse=True)
def solver(monkeypatch):
    """Says a quarter in causal answers and three quarters in refined ones; of frame 1 nothing in the end."""
    step, init, revisit = CausalSolver.step, CausalSolver.init, StandInSolver.refine_frame

    def likely(estimate, value):
        return replace(estimate, probability=np.full(estimate.mask.shape, value, np.float32))

    def refined(self, *given):
        state, estimate = revisit(self, *given)
        return state, estimate if estimate.index == 1 else likely(estimate, 0.75)

    def causal(method):
        def answered(self, *given):
            state, estimate = method(self, *given)
            return state, likely(estimate, 0.25)

        return answered

    monkeypatch.setattr(CausalSolver, "step", causal(step))
    monkeypatch.setattr(CausalSolver, "init", causal(init))
    monkeypatch.setattr(StandInSolver, "refine_frame", refined)
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)


def run(clip, folder: Path, *overrides: str) -> Path:
    quick = ["tracker.name=flow", "tracker.segmentation_size=64", "crop.size=32", "object.refine_masks=false"]
    record(
        open_source(str(folder.parent / "clip")),
        load_config(overrides=[*quick, *overrides]),
        folder,
        mask=clip.masks[0],
    )
    return folder


def test_it_is_read_as_it_was_written_in_steps_of_a_byte(tmp_path):
    probability = np.linspace(0, 1, 48 * 64, dtype=np.float32).reshape(48, 64)
    write_probability(tmp_path, 7, probability)
    assert np.abs(read_probability(tmp_path, 7) - probability).max() <= 0.51 / 255
    write_probability(tmp_path, 7, None)
    assert read_probability(tmp_path, 7) is None


def test_it_is_that_of_the_final_answers_and_stays_so_when_the_run_is_corrected(clip, tmp_path):
    folder = run(clip, tmp_path / "run", "runtime.probabilities=true")
    for _ in range(2):
        reader = RunReader(folder)
        found = [reader.probability(index) for index in range(FRAMES)]
        assert found[1] is None
        assert all(np.allclose(found[index], 0.75, atol=0.01) for index in (0, 2))
        assert RunReader(folder, refined=False).probability(0) is None
        assert not (folder / layout.REFINING).exists()
        correct_run(folder, [Correction(2, mask=clip.masks[2])])


def test_without_a_refinement_it_is_that_of_the_causal_answers(clip, tmp_path):
    folder = run(clip, tmp_path / "run", "runtime.probabilities=true", "solver.final_refine=false")
    assert np.allclose(RunReader(folder).probability(1), 0.25, atol=0.01)


def test_it_is_not_written_unless_it_is_asked_for(clip, tmp_path):
    folder = run(clip, tmp_path / "run")
    assert not (folder / layout.PROBABILITIES).exists()
    assert RunReader(folder).probability(0) is None
