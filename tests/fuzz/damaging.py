"""Damage as it happens to files: cut off, bits flipped, zeroed, grown, swapped for something else."""

from __future__ import annotations

import zlib
from pathlib import Path

from numpy.random import Generator

ODD_NAMES = (
    "with space",
    "new\nline",
    "tab\t",
    "ünïcödé ☃",
    "'quoted\"",
    "-dash",
    "%s{0}[a]*?",
    "[bold]x",
    "a" * 200,
    "...",
    "~",
    "$HOME",
    "a:b",
    "#1",
    "back\\slash",
)
"""Names that a file system takes."""

WORDS = (
    "", " ", "nan", "inf", "-inf", "-1", "0", "1", "2.5", "1e308", "-1e308", "1e-320", "99999999999999999999",
    "ß☃", "a\nb", "\t", "../..", "/", "/dev/null", "'", '"', "{}", "[]", "{a: 1}", "[1, 2]", "null", "~", "0x10",
    "1,2", "1,2,3,4", "10,8,20,20", "1,2,3,4,5", "-5,-5,1000,1000", "nan,1,2,3", "1e308,1e308,1e308,1e308",
    ",,,", "1:2", "1:3:1", ":::", "-1:", "0:99999999999999999999", "true", "no", "yes", "x" * 3000, "[/red]",
    "%s", "{0}", "--", "-", "--help", "rgb", "csrt", "paper", "default", "cpu", "cuda:7", "*", "?", "\udcff",
)  # fmt: skip
"""What may stand where a number, a name, a file or a list is due."""


def word(random: Generator) -> str:
    """One of `WORDS`."""
    return WORDS[int(random.integers(len(WORDS)))]


def pick(random: Generator, choices):
    """One of several things of any kind."""
    return choices[int(random.integers(len(choices)))]


def damaged(data: bytes, random: Generator) -> bytes:
    """The bytes of a file after an accident."""
    if not data:
        return data
    cut = int(random.integers(len(data)))
    kind = int(random.integers(8))
    if kind == 0:
        return data[:cut]
    if kind == 1:
        changed = bytearray(data)
        for _ in range(int(random.integers(1, 40))):
            changed[int(random.integers(len(data)))] ^= 1 << int(random.integers(8))
        return bytes(changed)
    if kind == 2:
        span = int(random.integers(1, max(len(data) // 4, 2)))
        return data[:cut] + bytes(span) + data[cut + span :]
    if kind == 3:
        return data + random.bytes(int(random.integers(1, 4000)))
    if kind == 4:  # the header only
        changed = bytearray(data)
        for _ in range(8):
            changed[int(random.integers(min(len(data), 64)))] = int(random.integers(256))
        return bytes(changed)
    if kind == 5:
        return random.bytes(int(random.integers(1, 2000)))
    if kind == 6:
        return bytes(len(data))
    span = int(random.integers(1, max(len(data) // 4, 2)))
    return data[:cut] + data[cut + span :]


def spoil(path: Path, random: Generator) -> str:
    """Do something to the file at ``path``; what was done, in words."""
    kind = int(random.integers(14))
    if kind < 8:
        path.write_bytes(damaged(path.read_bytes(), random))
        return f"{path.name} damaged"
    if kind == 8:
        path.write_bytes(b"")
        return f"{path.name} empty"
    path.unlink()
    if kind == 9:
        path.mkdir()
        return f"{path.name} is a folder"
    if kind == 10:
        path.symlink_to(path)
        return f"{path.name} links to itself"
    if kind == 11:
        path.symlink_to(path.parent / "nowhere")
        return f"{path.name} links to nothing"
    if kind == 12:
        path.write_text(word(random), "utf-8", "surrogateescape")
        return f"{path.name} holds a word"
    return f"{path.name} missing"


def with_png_size(data: bytes, width: int, height: int) -> bytes:
    """A PNG file whose header tells another size, with the right checksum."""
    header = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:29]
    return data[:12] + header + zlib.crc32(header).to_bytes(4, "big") + data[33:]
