"""Command lines whose options hold anything at all."""

from __future__ import annotations

from damaging import pick, word
from judging import Case

RUN_OPTIONS = (
    "--box", "--mask", "--masks", "--tracker", "--features", "--prototype", "--fov", "--intrinsics", "--out",
    "--frames", "--config", "--preset", "--set", "--size", "--device", "--seed", "--on-plugin-failure",
    "--points", "--start-frame", "--correct", "--quality",
)  # fmt: skip
RUN_FLAGS = (
    "--flat",
    "--trust-masks",
    "--overwrite",
    "--quiet",
    "--final-refine",
    "--no-final-refine",
    "--debug",
    "--nonsense",
)
SETTINGS = (
    "crop.size=32", "tracker.resolution=0.5", "tracker.path=x", "solver.name=paper", "solver.iterations=1",
    "object.texture_size=16", "camera.fov=1e-3", "features.scale=2", "runtime.threads=2", "=", "a", "a=", "a.b.c=1",
    ".=1", "tracker=flow", "tracker=csrt", "tracker.name=nope", "solver.online=5", "window=[32]", "solver={}",
)  # fmt: skip

OTHERS: tuple[tuple[str, ...], ...] = (
    ("points", "RUN", "--xy", "WORD"),
    ("points", "RUN", "--xy", "30,20", "--frame", "WORD"),
    ("points", "RUN", "--xy", "30,20", "--csv", "WORD"),
    ("points", "WORD", "--xy", "30,20", "--json"),
    ("evaluate", "answers", "RUN", "--truth", "WORD"),
    ("evaluate", "answers", "WORD", "--truth", "TRUTH"),
    ("evaluate", "answers", "RUN", "--truth", "TRUTH", "--format", "WORD"),
    ("evaluate", "answers", "RUN", "--truth", "TRUTH", "--option", "WORD"),
    ("evaluate", "answers", "RUN", "--truth", "TRUTH", "--answers", "WORD"),
    ("evaluate", "suite", "WORD"),
    ("evaluate", "suite", "TRUTH", "--jobs", "WORD", "--nonsense"),
    ("evaluate", "compare", "WORD", "WORD"),
    ("evaluate", "peer", "WORD", "--truth", "TRUTH"),
    ("evaluate", "table", "WORD"),
    ("config", "show", "--set", "WORD"),
    ("config", "show", "--preset", "WORD"),
    ("config", "show", "--config", "WORD"),
    ("config", "show", "--quality", "WORD"),
    ("config", "validate", "WORD"),
    ("config", "schema", "WORD"),
    ("plugins", "WORD"),
    ("plugins", "new", "WORD", "--kind", "tracker"),
    ("plugins", "new", "mine", "--kind", "WORD"),
    ("plugins", "new", "mine", "--kind", "features", "--out", "WORD"),
    ("models", "get", "WORD", "--from", "WORD"),
    ("models", "verify", "WORD"),
    ("models", "WORD"),
    ("synth", "made", "--object", "WORD", "--frames", "2", "--size", "32,24"),
    ("synth", "made", "--object", "box", "--motion", "WORD", "--frames", "2", "--size", "32,24"),
    ("synth", "made", "--object", "box", "--frames", "WORD", "--size", "WORD"),
    ("synth", "made", "--object", "box", "--degrees", "WORD", "--frames", "2", "--size", "32,24"),
    ("synth", "made", "--object", "box", "--fov", "WORD", "--frames", "2", "--size", "32,24"),
    ("synth", "made", "--object", "box", "--background", "WORD", "--frames", "2", "--size", "32,24"),
    ("synth", "made", "--suite", "WORD"),
    ("bench", "WORD"),
    ("bench", "masks", "WORD"),
    ("bench", "render", "--device", "WORD", "--nonsense"),
    ("demo", "--out", "RUN/run.json"),
    ("WORD",),
    ("WORD", "WORD"),
)
"""WORD stands for anything, RUN for a finished run, TRUTH for a clip."""


def command_lines(case: Case) -> None:
    """Call ``run`` or another command with odd options."""
    if case.random.random() < 0.55:
        _run(case)
        return
    places = {"RUN": str(case.material.folder / "run"), "TRUTH": str(case.material.folder / "truth")}
    pattern = pick(case.random, OTHERS)
    words = [word(case.random) if part == "WORD" else part for part in pattern]
    for name, place in places.items():
        words = [part.replace(name, place) if part.startswith(name) else part for part in words]
    if case.random.random() < 0.1:
        words.insert(int(case.random.integers(len(words) + 1)), word(case.random))
    # In a test --help and demo would do no harm, only take their time.
    case.command(*words)


def _run(case: Case) -> None:
    images = case.material.folder / "images"
    arguments: list[object] = []
    for _ in range(int(case.random.integers(1, 4))):
        if case.random.random() < 0.2:
            arguments.append(pick(case.random, RUN_FLAGS))
        elif case.random.random() < 0.3:
            arguments += ["--set", pick(case.random, SETTINGS)]
        else:
            arguments += [pick(case.random, RUN_OPTIONS), word(case.random)]
    source = images if case.random.random() < 0.85 else word(case.random)
    if case.random.random() < 0.7:
        case.run(source, *arguments)
    else:
        case.command("run", source, *arguments)
