"""ONNX files and their descriptions: damaged, of other shapes, or none."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from damaging import pick, spoil, word
from judging import Case

DESCRIPTIONS = (
    "{}", "input: 5", "input: {name: image}", "output: desc", "input: {name: image}\noutput: x\nstride: 0",
    "input: {name: image, multiple: 0}\noutput: x\nstride: 1", "input: {name: nope}\noutput: nope\nstride: 1",
    "input: {name: image, mean: [a]}\noutput: features\nstride: 4", "output: []\nstride: 1", "[]", "", "x",
    "input: {name: image}\noutput: [features, features]\ncombine: odd\nstride: 1",
    "input: {name: image, multiple: 1000000}\noutput: features\nstride: 4", "stride: -1", "stride: .nan",
)  # fmt: skip


def networks(case: Case) -> None:
    """Track with a feature encoder or a mask tracker on an odd network."""
    model = case.folder / "model.onnx"
    whole = resources.files("tracking3d.features") / "weights"
    source = next(item for item in whole.iterdir() if item.name.endswith(".onnx"))
    model.write_bytes(source.read_bytes())
    if case.random.random() < 0.7:
        case.story.append(spoil(model, case.random))
    description = case.folder / "description.yaml"
    description.write_text(pick(case.random, DESCRIPTIONS))
    known = pick(
        case.random, ["alike", "xfeat", "isnet", "sam", word(case.random), str(description), str(description)]
    )
    images = Path(case.material.folder / "images")
    case.story.append(f"description {known!r:.100} {description.read_text()!r}")
    if case.random.random() < 0.6:
        options = [
            "--features",
            "onnx",
            "--set",
            f"features.model={model}",
            "--set",
            f"features.description={known}",
        ]
    else:
        options = [
            "--tracker",
            "onnx",
            "--set",
            f"tracker.model={model}",
            "--set",
            f"tracker.description={known}",
        ]
        options += ["--set", f"tracker.box={pick(case.random, ['csrt', 'nano', 'vit', 'x'])}"]
    case.run(images, *options)
