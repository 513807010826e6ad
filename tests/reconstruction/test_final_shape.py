"""The final shape by configuration: reconstructed if it is asked for, and never at the cost of the run."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.config.loading import load_config
from tracking3d.config.models import ObjectConfig, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.reconstruction import final_shape, rebuild
from tracking3d.reconstruction.final_shape import make_final_shape

FINE = PipelineConfig.model_validate({"object": {"shape": "fine"}})
VIDEO = SimpleNamespace(name="a video", repeatable=True)


@pytest.fixture
def run(tmp_path):
    """A run folder as far as it matters here."""
    (tmp_path / "run.json").write_text('{"state": "finished"}')
    return tmp_path


def described(run):
    return json.loads((run / "run.json").read_text())


def test_what_came_of_it_is_said_and_kept(run, monkeypatch):
    asked = []
    monkeypatch.setattr(
        rebuild,
        "rebuild_shape",
        lambda *given: asked.append(given) or SimpleNamespace(sentence="Better."),
    )
    assert make_final_shape(run, FINE, VIDEO) == "Better."
    assert asked == [(run, VIDEO, 24, 2048)]
    assert described(run) == {"state": "finished", "shape": "Better."}


def test_a_run_whose_shape_cannot_be_made_anew_stays_as_it_is_and_says_why(run, monkeypatch):
    def refuse(*given):
        raise InputError("The packages are not there; install them.")

    monkeypatch.setattr(rebuild, "rebuild_shape", refuse)
    assert make_final_shape(run, FINE, VIDEO) == "The packages are not there; install them."
    assert described(run)["state"] == "finished"
    camera = SimpleNamespace(name="camera 0", repeatable=False)
    assert "camera 0 comes once only" in make_final_shape(run, FINE, camera)


def test_nothing_is_done_where_nothing_is_asked(run, monkeypatch):
    monkeypatch.setattr(rebuild, "rebuild_shape", lambda *given: pytest.fail("was not asked for"))
    fast = PipelineConfig.model_validate({"object": {"shape": "fast"}})
    assert make_final_shape(run, fast, VIDEO) == ""
    assert described(run) == {"state": "finished"}


def records(count, degrees, refined=True, status="tracked", free_axis=None):
    """Frames that turn by so many degrees in all."""
    turns = np.radians(np.linspace(0, degrees, count))
    poses = [Rotation.from_rotvec([0, turn, 0]).as_matrix() for turn in turns]
    said = {"refined": refined, "status": Status(status), "free_axis": free_axis}
    return [SimpleNamespace(T_cam_obj=np.pad(R, (0, 1)), **said) for R in poses]


@pytest.mark.parametrize(
    ("frames", "config", "video", "done"),
    [
        (records(12, 40), {}, VIDEO, True),
        (records(12, 15), {}, VIDEO, False),
        (records(12, 40, free_axis=(0.0, 1.0, 0.0)), {}, VIDEO, False),
        (records(7, 40), {}, VIDEO, False),
        (records(12, 40, refined=False), {}, VIDEO, False),
        (records(12, 40, status="uncertain"), {}, VIDEO, False),
        (records(12, 40), {"solver": {"name": "online", "final_refine": False}}, VIDEO, False),
        (records(12, 40), {"object": {"texture_views": 0}}, VIDEO, False),
        (records(12, 40), {}, SimpleNamespace(name="camera 0", repeatable=False), False),
    ],
)
def test_by_default_it_is_made_where_it_can_be(run, monkeypatch, frames, config, video, done):
    monkeypatch.setattr(final_shape, "RunReader", lambda folder: SimpleNamespace(frames=frames))
    monkeypatch.setattr(rebuild, "rebuild_shape", lambda *_: SimpleNamespace(sentence="Better."))
    said = make_final_shape(run, PipelineConfig.model_validate(config), video)
    assert said == ("Better." if done else "")


def test_without_the_packages_nothing_is_tried_by_default(run, monkeypatch):
    monkeypatch.setattr(final_shape, "RunReader", lambda folder: SimpleNamespace(frames=records(12, 40)))
    monkeypatch.setattr(rebuild, "has_packages", lambda: False)
    assert make_final_shape(run, PipelineConfig(), VIDEO) == ""


def test_the_best_quality_asks_for_it_and_what_is_known_is_held():
    assert load_config(quality="best").object.shape == "fine"
    assert load_config(quality="good").object.shape == "auto"
    assert ObjectConfig(model="mug.obj", shape="fine").shape == "fast"
