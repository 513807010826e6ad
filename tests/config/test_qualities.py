"""Qualities set tracker, window, refinement and model together, as a layer above the preset and below the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from tracking3d.config.loading import config_schema, layers_in_words, list_qualities, load_config
from tracking3d.errors import InputError


def test_every_quality_is_valid_with_every_preset():
    assert list_qualities() == ["draft", "good", "best"]
    for quality in list_qualities():
        for preset in ("default", "rerendering"):
            load_config(preset=preset, quality=quality)


def test_good_is_what_is_used_when_nothing_is_said():
    assert load_config(quality="good") == load_config()


def test_each_quality_looks_closer_than_the_one_before():
    configs = [load_config(quality=name) for name in list_qualities()]
    assert [config.tracker.name for config in configs] == ["flow", "auto", "auto"]
    assert [config.solver.final_refine for config in configs] == [False, True, True]
    assert [config.crop.size for config in configs] == sorted({config.crop.size for config in configs})


def test_what_lies_above_wins(tmp_path: Path):
    file = tmp_path / "mine.yaml"
    file.write_text("quality: draft\ncrop: {size: 64}\n")
    config = load_config(file, overrides=["solver.final_refine=true"])
    assert (config.tracker.name, config.crop.size, config.solver.final_refine) == ("flow", 64, True)
    config = load_config(file, quality="best", tracker="csrt")
    assert (config.tracker.name, config.crop.size, config.object.texture_size) == ("csrt", 64, 300)


def test_layers_are_told_in_words(tmp_path: Path):
    file = tmp_path / "mine.yaml"
    file.write_text("preset: paper\nquality: draft\ntracker: csrt\n")
    words = layers_in_words(file)
    assert [line.partition(":")[0] for line in words] == ["preset paper", "quality draft", str(file)]
    assert "crop.size=96" in words[1]
    assert words[2].endswith("tracker.name=csrt")


def test_the_schema_has_it():
    assert config_schema()["properties"]["quality"]["enum"] == list_qualities()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("quality: drat", "There is no quality 'drat'; did you mean 'draft'"),
        ("quality: 3", "'quality' must be the name of a quality"),
        ("quality: [best]", "'quality' must be the name of a quality"),
    ],
)
def test_another_name_is_refused(tmp_path: Path, text, sentence):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=sentence):
        load_config(file)
    with pytest.raises(InputError, match="There is no quality 'x'"):
        load_config(quality="x")


def test_nothing_behind_the_colon_chooses_nothing(tmp_path: Path):
    file = tmp_path / "mine.yaml"
    file.write_text("quality:\n")
    assert load_config(file) == load_config()
