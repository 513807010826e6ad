"""Folders of images of every kind and condition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from damaging import ODD_NAMES, pick, spoil, with_png_size
from judging import Case
from PIL import Image

MODES = ("1", "L", "LA", "P", "RGBA", "CMYK", "I;16", "I", "F", "YCbCr", "LAB", "HSV", "RGBX")
SUFFIXES = {
    "1": "png tif", "L": "png jpg bmp pgm", "LA": "png", "P": "png gif", "RGBA": "png webp", "CMYK": "jpg tif",
    "I;16": "png tif", "I": "tif", "F": "tif", "YCbCr": "jpg", "LAB": "tif", "HSV": "", "RGBX": "",
}  # fmt: skip


def images(case: Case) -> None:
    """Track a folder of images in which some are not as the others."""
    folder = case.material.copy("images", case.folder)
    files = sorted(folder.iterdir())
    action = pick(case.random, [_spoiled, _spoiled, _converted, _sized, _turned, _bomb, _named, _crowded])
    for _ in range(int(case.random.integers(1, 4))):
        victim = pick(case.random, files)
        if victim.is_file():
            action(case, victim)
    source = pick(case.random, [folder, folder, f"{folder}/*", f"{folder}/[0-9]*.p?g", f"{folder}/**"])
    case.run(source)


def _spoiled(case: Case, victim: Path) -> None:
    case.story.append(spoil(victim, case.random))


def _converted(case: Case, victim: Path) -> None:
    mode = pick(case.random, [mode for mode in MODES if SUFFIXES[mode]])
    suffix = pick(case.random, SUFFIXES[mode].split())
    with Image.open(victim) as image:
        if mode == "I;16":
            grey = np.asarray(image.convert("L")).astype(np.uint16) * 257
            converted = Image.fromarray(grey)
        elif mode == "LAB":
            converted = Image.new("LAB", image.size)
        else:
            converted = image.convert(mode)
    victim.unlink()
    converted.save(victim.with_suffix(f".{suffix}"))
    case.story.append(f"{victim.name} as {mode} in {suffix}")


def _sized(case: Case, victim: Path) -> None:
    size = pick(case.random, [(1, 1), (2, 1), (1, 500), (63, 47), (65, 49), (640, 480), (48, 64), (3, 3)])
    everything = case.random.random() < 0.5
    for file in sorted(victim.parent.iterdir()) if everything else [victim]:
        if file.is_file():
            Image.effect_noise(size, 60).convert("RGB").save(file)
    case.story.append(f"{'all' if everything else victim.name} of {size}")


def _turned(case: Case, victim: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = int(case.random.integers(0, 12))
    exif.get_ifd(0x8769)[0xA405] = int(pick(case.random, [0, 1, 28, 65535]))
    with Image.open(victim) as image:
        image.load()
    victim.unlink()
    image.save(victim.with_suffix(".jpg"), exif=exif)
    case.story.append(f"{victim.name} turned by EXIF {exif[0x0112]}")


def _bomb(case: Case, victim: Path) -> None:
    sizes = [(100_000, 100_000), (2**31 - 1, 2**31 - 1), (0, 0), (12_000, 12_000), (64, 1_000_000), (64, 0)]
    width, height = pick(case.random, sizes)
    victim.write_bytes(with_png_size(victim.read_bytes(), width, height))
    case.story.append(f"{victim.name} says that it is {width} x {height}")


def _named(case: Case, victim: Path) -> None:
    name = pick(case.random, ODD_NAMES) + pick(case.random, [".png", ".PNG", ".jpg", "", ".png.png"])
    case.story.append(f"{victim.name} named {name!r}")
    victim.rename(victim.with_name(name))


def _crowded(case: Case, victim: Path) -> None:
    folder = victim.parent
    other = pick(
        case.random, ["notes.txt", "Thumbs.db", ".hidden.png", "mask.npz", "clip.mp4", "z.svg", "z.heic"]
    )
    (folder / other).write_bytes(case.random.bytes(int(case.random.integers(0, 300))))
    (folder / "folder.png").mkdir(exist_ok=True)
    case.story.append(f"beside {other} and a folder")
