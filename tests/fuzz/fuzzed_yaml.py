"""Configuration files and ``--set``: YAML that is no mapping, no YAML, or holds what a key does not take."""

from __future__ import annotations

from damaging import damaged, pick, spoil, word
from judging import Case

from tracking3d.config.models import PipelineConfig

DOCUMENTS = (
    "", "---", "--- \n---\n", "null", "[]", "1", "text", "{}", "a: b", "tracker: [csrt]", "tracker: {}", "tracker: 5",
    "tracker: {name: 5}", "tracker: {name: csrt, resolution: .nan}", "tracker: {name: precomputed}",
    "tracker: {name: precomputed, path: [1]}", "features: {name: onnx}", "features: {name: onnx, model: 3}",
    "preset: 5", "preset: [paper]", "preset: nope", "preset: {a: b}", "camera: {intrinsics: 5}", "camera: 5",
    "camera: {intrinsics: [1, 2, 3]}", "camera: {intrinsics: [a, b, c, d]}", "camera: {fov: .inf}",
    "camera: {fov: '45'}", "solver: [1]", "solver: {weights: 5}", "solver: {weights: {features: .nan}}",
    "runtime: {threads: 1e9}", "runtime: {threads: 0}", "runtime: {device: 5}", "runtime: {device: ''}",
    "runtime: {renderer: fast}", "crop: {size: 31}", "crop: {size: 32.5}", "crop: {size: '64'}",
    "crop: {size: true}", "object: {prototype: 5}", "object: {frequency: -1}", "object: {texture_size: 1e3}",
    "a: &a [*a]", "a: &a {b: *a}", "tracker: &t {name: csrt}\nfeatures: *t", "<<: {crop: {size: 64}}",
    "crop: {<<: {size: 64}, margin: 0.2}", "? [a, b]\n: c", "? {a: b}\n: c", "1: 2", "null: 3", "true: 1",
    "crop: !!python/object/apply:os.system [echo]", "crop: !!set {size}", "crop: !!binary aGk=",
    "!!omap [a: b]", "crop: {size: 2020-01-01}", "crop:\n\tsize: 64", "crop: {size: 64", "crop: 'open",
    "&a a: *b", "%YAML 9.9\n---\na: b", "crop: {size: 64}\ncrop: {size: 32}", "%TAG ! tag:x:\n---\n!a b",
    "crop: {size: 0o100}", "crop: {size: 0x40}", "crop: {size: 1_0_0}", "crop: {size: 1:30}",
    "[" * 500, "{a: " * 2000, "- " * 2000, "a: " + "x" * 100_000, "\ufeffcrop: {size: 64}", "a: \x07", "# only",
    "a: &x [l, l, l, l, l, l, l, l, l]\nb: &y [*x, *x, *x, *x, *x, *x, *x, *x]\nc: &z [*y, *y, *y, *y, *y, *y, *y]\n"
    "d: &u [*z, *z, *z, *z, *z, *z, *z]\ne: &v [*u, *u, *u, *u, *u, *u, *u]\nf: [*v, *v, *v, *v, *v, *v, *v, *v]",
)  # fmt: skip


def yaml_files(case: Case) -> None:
    """Show, check or use a configuration of some kind."""
    file = case.material.copy("tiny.yaml", case.folder)
    kind = int(case.random.integers(7))
    if kind < 3:
        file.write_text(pick(case.random, DOCUMENTS), encoding="utf-8")
        case.story.append(repr(file.read_text(encoding="utf-8")[:80]))
    elif kind == 3:
        case.story.append(spoil(file, case.random))
    elif kind == 4:  # sensible text in part
        text = file.read_bytes() + pick(case.random, DOCUMENTS).encode()
        file.write_bytes(damaged(text, case.random) if case.random.random() < 0.5 else text)
    elif kind == 5:
        paths = _paths(PipelineConfig().model_dump())
        settings = [
            f"{pick(case.random, paths)}={_value(case)}" for _ in range(int(case.random.integers(1, 3)))
        ]
        case.command("config", "show", *(part for setting in settings for part in ("--set", setting)))
        return
    else:
        file = pick(
            case.random, [case.folder, case.material.folder / "clip.mp4", case.folder / word(case.random)]
        )
    if case.random.random() < 0.4:
        case.command("config", "validate", "--", file)
    elif case.random.random() < 0.5:
        case.command("config", "show", "--config", file)
    else:
        case.command(
            "run",
            case.material.folder / "images",
            "--box",
            case.material.box,
            "--config",
            file,
            "--frames",
            "0:2",
        )


def _paths(settings: dict, prefix: str = "") -> list[str]:
    paths = []
    for key, value in settings.items():
        paths += [prefix + key, *(_paths(value, f"{prefix}{key}.") if isinstance(value, dict) else ())]
    return paths


def _value(case: Case) -> str:
    return word(case.random) if case.random.random() < 0.6 else pick(case.random, DOCUMENTS[:60])
