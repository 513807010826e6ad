"""The final shape by configuration: reconstructed if it is asked for, and never at the cost of the run."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from tracking3d.config.loading import load_config
from tracking3d.config.models import ObjectConfig, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.reconstruction import final_shape
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
        final_shape,
        "rebuild_shape",
        lambda *given: asked.append(given) or SimpleNamespace(sentence="Better."),
    )
    assert make_final_shape(run, FINE, VIDEO) == "Better."
    assert asked == [(run, VIDEO)]
    assert described(run) == {"state": "finished", "shape": "Better."}


def test_a_run_whose_shape_cannot_be_made_anew_stays_as_it_is_and_says_why(run, monkeypatch):
    def refuse(*given):
        raise InputError("The packages are not there; install them.")

    monkeypatch.setattr(final_shape, "rebuild_shape", refuse)
    assert make_final_shape(run, FINE, VIDEO) == "The packages are not there; install them."
    assert described(run)["state"] == "finished"
    camera = SimpleNamespace(name="camera 0", repeatable=False)
    assert "camera 0 comes once only" in make_final_shape(run, FINE, camera)


def test_nothing_is_done_where_nothing_is_asked(run, monkeypatch):
    monkeypatch.setattr(final_shape, "rebuild_shape", lambda *given: pytest.fail("was not asked for"))
    assert make_final_shape(run, PipelineConfig(), VIDEO) == ""
    assert described(run) == {"state": "finished"}


def test_the_best_quality_asks_for_it_and_what_is_known_is_held():
    assert load_config(quality="best").object.shape == "fine"
    assert load_config(quality="good").object.shape == "fast"
    assert ObjectConfig(model="mug.obj", shape="fine").shape == "fast"
