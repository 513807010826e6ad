"""The package index's page: the README with links that work there. All else is said in pyproject.toml.

Links to files of the repository are made absolute with the URL ``Source`` of pyproject.toml. Without one they become
plain text that names the file, which the source distribution holds, and pictures become their captions: no link of
the page leads nowhere.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent
_FENCED = re.compile(r"(^```.*?^```$)", re.M | re.S)
_LINK = re.compile(r"(?P<picture>!?)\[(?P<text>[^]]*)\]\((?P<target>[^)\s]+)\)")


def index_page(readme: str, source: str | None) -> str:
    """The README for a reader who has no checkout.

    Args:
        readme: Markdown with links relative to the repository's root.
        source: The repository's address, or None where it has none yet.
    """

    def rewritten(link: re.Match[str]) -> str:
        picture, text, target = link["picture"], link["text"], link["target"]
        if re.match(r"https?:|#", target):
            return link[0]
        if source:
            kind = "raw" if picture else "blob"
            return f"{picture}[{text}]({source.rstrip('/')}/{kind}/HEAD/{target})"
        if picture:
            return f"*{text}*"
        file = target.partition("#")[0]
        return text if file in text else f"{text} ({file})"

    parts = _FENCED.split(readme)  # every other part is a block of code
    parts[::2] = [_LINK.sub(rewritten, part) for part in parts[::2]]
    return "".join(parts)


if __name__ == "__main__":
    from setuptools import setup

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    setup(
        long_description=index_page(
            (ROOT / "README.md").read_text(encoding="utf-8"), project["urls"].get("Source")
        ),
        long_description_content_type="text/markdown",
    )
