"""Masks of the first frame or of all frames: of other sizes, values and kinds, damaged, empty or full."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from damaging import ODD_NAMES, pick, spoil, word
from judging import Case
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image


def masks(case: Case) -> None:
    """Track with ``--mask`` or ``--masks`` of some kind."""
    action = pick(case.random, [_first_mask, _first_mask, _folder, _folder, _arrays, _arrays, _other])
    action(case)


def _first_mask(case: Case) -> None:
    file = case.material.copy("mask.png", case.folder)
    if case.random.random() < 0.4:
        case.story.append(spoil(file, case.random))
    else:
        _save(_values(case), file, case.random)
    if case.random.random() < 0.2 and file.is_file():
        file = file.rename(case.folder / f"{pick(case.random, ODD_NAMES)}.png")
    case.run(case.material.folder / "images", "--mask", file, box=False)


def _folder(case: Case) -> None:
    folder = case.material.copy("masks", case.folder)
    for file in sorted(folder.iterdir()):
        chance = case.random.random()
        if chance < 0.3:
            case.story.append(spoil(file, case.random))
        elif chance < 0.6:
            _save(_values(case), file, case.random)
        elif chance < 0.7:
            file.rename(folder / f"{pick(case.random, ODD_NAMES)}.png")
    case.run(case.material.folder / "images", "--masks", folder, box=case.random.random() < 0.3)


def _arrays(case: Case) -> None:
    file = case.folder / "masks.npz"
    kind = int(case.random.integers(5))
    if kind == 0:
        case.material.copy("masks.npz", case.folder)
        case.story.append(spoil(file, case.random))
    elif kind == 1:
        file = case.material.copy("masks.npy", case.folder)
        case.story.append(spoil(file, case.random))
    elif kind == 2:
        np.savez(file, **{word(case.random).replace("/", "_") or "empty": _values(case) for _ in range(3)})
    elif kind == 3:
        file = file.with_suffix(".npy")
        np.save(file, np.stack([_values(case, fixed=True) for _ in range(int(case.random.integers(1, 5)))]))
    else:
        odd = [np.array(3), np.array([]), np.zeros((0, 48, 64)), np.array([None, {}]), np.array("mask")]
        odd += [np.zeros((2, 2, 2, 2, 2)), np.zeros((3, 48, 64), complex), np.full((3, 48, 64), np.nan)]
        np.savez(file, masks=pick(case.random, odd))
    case.run(case.material.folder / "images", "--masks", file, box=False)


def _other(case: Case) -> None:
    other = pick(
        case.random, ["clip.mp4", "clip.gif", "mesh.obj", "run", "run/masks", "images", "tiny.yaml", "."]
    )
    option = pick(case.random, ["--mask", "--masks"])
    case.run(case.material.folder / "images", option, case.material.folder / other, box=False)


def _values(case: Case, fixed: bool = False) -> NDArray:
    """A mask of some type, some size and some values."""
    random = case.random
    size = (48, 64) if fixed else pick(random, [(48, 64)] * 4 + [(64, 48), (1, 1), (47, 64), (480, 640)])
    dtype = np.uint8 if fixed else pick(random, [bool, np.uint8, np.uint16, np.int32, np.float32])
    kind = int(random.integers(8))
    case.story.append(f"mask {size} {np.dtype(dtype)} of kind {kind}")
    values = np.zeros(size)
    rows, columns = slice(size[0] // 4, size[0] // 2 + 1), slice(size[1] // 4, size[1] // 2 + 1)
    match kind:
        case 0:
            pass
        case 1:
            values[:] = 1
        case 2:
            values[rows, columns] = 1
        case 3:
            values[rows, columns] = 255
        case 4:
            values[:] = random.random(size) < 0.5
        case 5:
            values[0, 0] = 1
        case 6:
            values[-1, :] = 200
        case _:
            values[rows, columns] = 127
            values[0, :] = 3
    return values.astype(dtype)


def _save(values: NDArray, file: Path, random: Generator) -> None:
    file.unlink(missing_ok=True)
    if values.dtype == np.float32:
        Image.fromarray(values).save(file.with_suffix(".tif"))
        file.with_suffix(".tif").rename(file)
        return
    image = Image.fromarray(values.astype(np.uint8) if values.dtype == np.int32 else values)
    if values.dtype == np.uint8 and random.random() < 0.5:
        image = image.convert(pick(random, ["RGB", "RGBA", "P", "LA", "1"]))
    image.save(file)
