"""A run with a final refinement ends with the texture of its video, from the frames that are believed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rendered_views import ball, pattern, pose, seen

from tracking3d import load_config
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS
from tracking3d.results.files import write_image
from tracking3d.results.mesh_export import load_model
from tracking3d.video import open_source

YAWS = (0, 15, 30)


class KnowingSolver(RefiningSolver):
    """Answers with the truth of the ball; tracked or not in the second pass, as ``status`` says."""

    status = Status.TRACKED

    def __init__(self, config, camera, encoder) -> None:
        pass

    def init(self, frame: Frame, mask: MaskEstimate):
        return 0, self._answer(frame)

    def step(self, state: int, frame: Frame, mask: MaskEstimate):
        return state, self._answer(frame)

    def refine(self, state: int) -> int:
        return state

    def refine_frame(self, state: int, frame: Frame, mask: MaskEstimate, T_cam_obj):
        return state, replace(self._answer(frame), refined=True)

    def result(self, state: int) -> ObjectModel:
        return ball()

    def _answer(self, frame: Frame) -> FrameEstimate:
        T_cam_obj = pose(YAWS[frame.index])
        mask = seen(T_cam_obj, pattern())[1]
        return FrameEstimate(frame.index, frame.time, T_cam_obj, mask, mask, self.status, "", 0.9)


def recorded(folder: Path, *overrides: str) -> ObjectModel:
    images = folder / "frames"
    images.mkdir()
    for index, yaw in enumerate(YAWS):
        write_image(images / f"{index:03d}.png", seen(pose(yaw), pattern())[0])
    settings = load_config(overrides=["tracker.name=flow", "camera.fov=30", *overrides])
    record(open_source(str(images)), settings, folder / "run", mask=seen(pose(0), pattern())[1])
    return load_model(folder / "run")


@pytest.fixture(autouse=True)
def solver(monkeypatch) -> None:
    monkeypatch.setitem(SOLVERS, "online", KnowingSolver)


def test_the_refined_mesh_has_the_texture_of_the_video(tmp_path):
    model = recorded(tmp_path)
    assert len(model.texture) > 100
    assert model.texture[model.texture_weight > 0.3].std() > 20
    assert len(load_model(tmp_path / "run" / "causal").texture) == 16  # the solver's


@pytest.mark.parametrize(
    "override", ["object.texture_views=0", "solver.final_refine=false", "object.max_texture_size=64"]
)
def test_settings_leave_it_out_or_bound_it(tmp_path, override):
    assert len(recorded(tmp_path, override).texture) == (64 if "max_texture_size" in override else 16)


def test_frames_that_are_not_tracked_have_no_say(tmp_path, monkeypatch):
    monkeypatch.setattr(KnowingSolver, "status", Status.UNCERTAIN)
    assert np.array_equal(recorded(tmp_path).texture, ball().texture)
