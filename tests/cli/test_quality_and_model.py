"""``--quality`` and ``--model`` mean the same in every command that has them."""

from __future__ import annotations

import pytest

from tracking3d.config.loading import MODELS, QUALITIES

BOX = ("--box", "20,10,20,20")
WITH_MODEL = {
    "run": ("clip", *BOX),
    "pick": ("clip",),
    "model": ("run",),
    "batch": ("clips", "--out", "runs"),
}
WITH_QUALITY = {
    "run": ("clip", *BOX),
    "pick": ("clip",),
    "batch": ("clips", "--out", "runs"),
    "config show": (),
    "evaluate suite": ("smoke",),
    "bench track": (),
    "model": ("run",),  # which had this option with other words
}


@pytest.mark.parametrize("command", WITH_MODEL)
@pytest.mark.parametrize("word", QUALITIES)
def test_a_quality_is_no_final_mesh(refused, command, word):
    line = refused(*command.split(), *WITH_MODEL[command], "--model", word)
    assert (
        line
        == f"error: --model sets auto, none, fast or fine; {word} is a value of --quality: --quality {word}."
    )


@pytest.mark.parametrize("command", WITH_QUALITY)
@pytest.mark.parametrize("word", MODELS)
def test_a_final_mesh_is_no_quality(refused, command, word):
    line = refused(*command.split(), *WITH_QUALITY[command], "--quality", word)
    assert line == f"error: --quality sets draft, good or best; {word} is a value of --model: --model {word}."


@pytest.mark.parametrize("command", WITH_MODEL)
def test_an_unknown_final_mesh_is_refused(refused, command):
    assert "--model finest is unknown" in refused(*command.split(), *WITH_MODEL[command], "--model", "finest")


@pytest.mark.parametrize("command", WITH_QUALITY)
def test_an_unknown_quality_is_refused(refused, command):
    assert "did you mean 'best'" in refused(*command.split(), *WITH_QUALITY[command], "--quality", "bests")


def test_the_mesh_of_an_existing_run_has_no_quality(refused):
    assert "--model auto, none, fast or fine" in refused("model", "run", "--quality", "best")


@pytest.mark.parametrize("word", ["fast", "fine"])
@pytest.mark.parametrize("command", ["run", "pick"])
def test_a_camera_cannot_be_read_twice(refused, command, word):
    assert "a camera does not allow" in refused(command, "0", "--model", word)


def test_a_texture_that_would_not_be_made_is_refused(refused, clip, script):
    assert "without the final refinement" in refused(
        "run", clip, *BOX, "--quality", "draft", "--model", "fast"
    )
    assert script.built == []


@pytest.mark.parametrize(
    ("word", "views", "shape"), [("none", 0, "fast"), ("fast", 24, "fast"), ("fine", 24, "fine")]
)
def test_run_and_pick_make_the_mesh_that_was_asked_for(call, clip, script, monkeypatch, word, views, shape):
    monkeypatch.setattr("tracking3d.pipeline.record.make_final_shape", lambda *_: "")
    asked = []
    monkeypatch.setattr(
        "tracking3d.cli.pick.open_picker", lambda request, *given: asked.append(request.config) or 1 / 0
    )
    assert call("run", clip, *BOX, "--quality", "best", "--model", word, "--out", "run").exit_code == 0
    call("pick", clip, "--quality", "best", "--model", word, "--out", "picked")
    for config in (script.built[0][0], asked[0]):
        assert (config.object.texture_views, config.object.shape) == (views, shape)
        assert config.crop.size == 192
