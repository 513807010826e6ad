"""First shapes: mesh files that are damaged, degenerate, or none."""

from __future__ import annotations

from damaging import pick, spoil, word
from judging import Case

OBJ = (
    "", "v 0 0 0", "f 1 2 3", "v 0 0 0\nf 1 1 1", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9",
    "v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4",
    "v inf 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4",
    "v 1e30 0 0\nv 1 0 0\nv 0 1e-30 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4",
    "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3",
    "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf -1 -2 -3\nf 1 2 -9", "v 5 5 5\n" * 4 + "f 1 2 3\nf 2 3 4",
    "v a b c\nf x y z", "mtllib nowhere.mtl\nusemtl x\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1/1 2/2 3/3",
    "l 1 2\np 1", "v 0 0\nv 1\nf 1 2 3", "\x00\x01\x02", "v 0 0 0 " * 1000,
    "v 1e9 1e9 1e9\nv 1000000001 1e9 1e9\nv 1e9 1000000001 1e9\nv 1e9 1e9 1000000001\nf 1 2 3\nf 1 2 4\nf 1 3 4",
)  # fmt: skip


def meshes(case: Case) -> None:
    """Start a run, or make a sequence, from a shape of some kind."""
    suffix = pick(case.random, ["obj", "obj", "ply", "stl", "glb", "off"])
    file = case.material.copy(f"mesh.{suffix}", case.folder)
    kind = int(case.random.integers(5))
    if kind < 2:
        case.story.append(spoil(file, case.random))
    elif kind == 2:
        file = file.rename(
            file.with_suffix(pick(case.random, [".obj", ".ply", ".stl", ".glb", ".dae", ".txt", ""]))
        )
    elif kind == 3:
        file = case.folder / "odd.obj"
        file.write_text(pick(case.random, OBJ))
        case.story.append(repr(file.read_text()[:80]))
    else:
        file = pick(case.random, [word(case.random), case.material.folder / "mask.png", case.folder])
    if case.random.random() < 0.15:
        case.command(
            "synth", case.folder / "made", "--object", file, "--frames", 2, "--size", "32,24", "--quiet"
        )
    else:
        flat = ["--flat"] if case.random.random() < 0.2 else []
        case.run(case.material.folder / "images", *flat, "--prototype", file)
