"""A hook of mkdocs: what its Markdown and theme need that the pages, as they lie in the repository, do not.

Links to files of the repository that are no pages become their text, or lead to the repository where ``repo_url`` of
mkdocs.yml says where that is. What belongs to an item of a list is indented by four spaces. No script is fetched.
"""

from __future__ import annotations

import posixpath
import re
from typing import Any

_LINK = re.compile(r"\[(?P<text>[^]]*)\]\((?P<target>(?:\.\./)+[^)\s]+)\)")
_FETCHED_SCRIPT = re.compile(r'<script src="https?://[^"]*"[^>]*></script>')


def on_page_markdown(markdown: str, *, page: Any, config: Any, **_: Any) -> str:
    """Called by mkdocs with the text of each page."""
    folder = posixpath.join("docs", posixpath.dirname(page.file.src_uri))
    return with_links(with_four_spaces(markdown), folder, config["repo_url"])


def on_post_page(output: str, **_: Any) -> str:
    """Called by mkdocs with each whole page; the theme asks a server of others for what file:// lacks in search."""
    return _FETCHED_SCRIPT.sub("", output)


def with_links(markdown: str, folder: str, repository: str | None) -> str:
    """The text of a page in ``folder``, without links that lead out of the documentation."""

    def rewritten(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link["target"]))
        if target.startswith("docs/"):
            return link[0]
        return (
            f"[{link['text']}]({repository.rstrip('/')}/blob/HEAD/{target})" if repository else link["text"]
        )

    return _LINK.sub(rewritten, markdown)


def with_four_spaces(markdown: str) -> str:
    """Two or three spaces before a line of a list's item become four; blocks of code of their own stay."""
    lines, within_code = markdown.split("\n"), False
    for n, line in enumerate(lines):
        if line.startswith("```"):
            within_code = not within_code
        elif not within_code:
            lines[n] = re.sub(r"^ {2,3}(?=\S)", "    ", line)
    return "\n".join(lines)
