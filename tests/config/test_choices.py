"""Quality and final mesh have words of their own; a word of the other choice is answered with where it belongs."""

from __future__ import annotations

import pytest

from tracking3d.config.loading import MODELS, QUALITIES, check_model, check_quality, load_config, set_model
from tracking3d.errors import InputError


def test_the_words_are_their_own_and_no_word_is_in_both():
    assert [check_quality(word) for word in QUALITIES] == ["draft", "good", "best"]
    assert [check_model(word) for word in MODELS] == ["auto", "none", "fast", "fine"]
    assert not set(QUALITIES) & set(MODELS)


@pytest.mark.parametrize("word", MODELS)
def test_a_final_mesh_given_as_a_quality_is_sent_to_model(word):
    with pytest.raises(InputError) as error:
        check_quality(word)
    assert error.value.at_the_command_line == (
        f"--quality sets draft, good or best; {word} is a value of --model: --model {word}."
    )
    with pytest.raises(InputError, match=f"^quality= sets draft, good or best; .* model='{word}'"):
        load_config(quality=word)


@pytest.mark.parametrize("word", QUALITIES)
def test_a_quality_given_as_a_final_mesh_is_sent_to_quality(word):
    with pytest.raises(InputError) as error:
        check_model(word)
    assert error.value.at_the_command_line == (
        f"--model sets auto, none, fast or fine; {word} is a value of --quality: --quality {word}."
    )
    assert f"quality='{word}'" in str(error.value)


@pytest.mark.parametrize("value", ["", "Fine", "finest", 3, None, ["fine"], b"fine"])
def test_any_other_value_is_refused_by_both(value):
    with pytest.raises(InputError, match="There is no quality"):
        check_quality(value)
    with pytest.raises(InputError, match="give 'auto', 'none', 'fast' or 'fine'"):
        check_model(value)


@pytest.mark.parametrize(
    ("word", "key"),
    [
        ("auto", "object.shape: auto"),
        ("none", "texture_views: 0"),
        ("fast", "object.shape: fast"),
        ("fine", "object.shape: fine"),
    ],
)
def test_a_file_is_told_its_own_key(tmp_path, word, key):
    file = tmp_path / "config.yaml"
    file.write_text(f"quality: {word}\n")
    with pytest.raises(InputError, match=f"config.yaml: quality sets draft, good or best; .*{key}"):
        load_config(file)


@pytest.mark.parametrize(
    ("word", "views", "shape"),
    [("auto", 24, "auto"), ("none", 0, "fast"), ("fast", 24, "fast"), ("fine", 24, "fine")],
)
@pytest.mark.parametrize("quality", ["good", "best"])
def test_a_final_mesh_overrides_that_of_the_quality(quality, word, views, shape):
    config = load_config(quality=quality)
    changed = set_model(config, word).object
    assert (changed.texture_views, changed.shape) == (views, shape)
    assert set_model(config, None) == config


def test_a_texture_from_the_video_is_made_even_where_the_configuration_switched_it_off():
    config = load_config(overrides=["object.texture_views=0"])
    assert set_model(config, "fast").object.texture_views == 24


def test_what_cannot_be_made_is_refused_and_not_left_out():
    with pytest.raises(InputError, match="without the final refinement"):
        set_model(load_config(quality="draft"), "fast")
    known = load_config(object={"model": "mug.obj"})
    assert set_model(known, "none").object.texture_views == 0
    for word, what in [("fast", "texture"), ("fine", "shape")]:
        with pytest.raises(
            InputError, match=f"makes the {what} again, but those of a known object are fixed"
        ):
            set_model(known, word)
