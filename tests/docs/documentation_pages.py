"""The documentation as text: its files, and the blocks of code in them."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent

ROOT = Path(__file__).resolve().parents[2]
HOW_TO = sorted(ROOT.glob("docs/how-to/*.md"))
"""Pages whose commands build on one another; a slow test runs each from top to bottom."""
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *sorted(ROOT.glob("docs/**/*.md")),
    *sorted(ROOT.glob("plugins/tracking3d-bench/benchmarks/*.md")),
    *sorted(ROOT.glob("plugins/*/README.md")),
    *sorted(ROOT.glob("examples/**/*.md")),
]

HISTORY = sorted(ROOT.glob("history/**/*.md"))
"""Pages as they were: what they say of the program was true on their day."""

_BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\w*)\n(?P<text>.*?)^(?P=indent)```$", re.M | re.S)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of one language, in order."""
    found = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [dedent(block["text"]) for block in found if block["language"] == language]


def commands(page: Path, program: str) -> list[str]:
    """What the console blocks tell the reader to type that begins with ``program``, without that."""
    lines = "".join(blocks(page, "console")).replace("\\\n", " ").splitlines()
    typed = [line.removeprefix("$ ").partition(" #")[0].strip() for line in lines]
    return [line.removeprefix(f"{program} ") for line in typed if line.startswith(f"{program} ")]


def pages_with(language: str) -> list[Path]:
    """The pages that have a block of that language."""
    return [page for page in PAGES if blocks(page, language)]


def label(page: Path) -> str:
    """What a test calls a page."""
    return str(page.relative_to(ROOT))
