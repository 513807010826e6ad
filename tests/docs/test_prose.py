"""Sentences over which readers stumbled stay away, from pages, messages and docstrings."""

from __future__ import annotations

import re

import pytest
from documentation_pages import PAGES, ROOT

TEXTS = [
    *(page for page in PAGES if page.is_relative_to(ROOT / "docs") or page.name == "README.md"),
    *(path for path in sorted((ROOT / "tracking3d").rglob("*")) if path.suffix in (".py", ".html", ".js")),
]


@pytest.mark.parametrize(
    "phrase",
    [
        "Once nine tenths of",
        "have been brought to agree by a similarity",
        "takes up at once what the mask gains",
        "of what is visible `segment` has",
        "since both share the interpreter",
        "replaces hundreds of iterations of Adam",
        "takes longest: nothing runs in the background",
        "what was found may be another object",
        "degrees, upright",
        "hardly turn any more",
        "every so many",
        "as another lens would have",
        "put right by",
        "the more the more",
    ],
)
def test_a_sentence_that_readers_stumbled_over_is_gone(phrase):
    spaced = re.compile(r"\s+".join(map(re.escape, phrase.split())))
    found = [text.relative_to(ROOT).as_posix() for text in TEXTS if spaced.search(text.read_text("utf-8"))]
    assert found == []


def test_an_unreleased_entry_of_the_changelog_takes_at_most_three_lines():
    changelog = (ROOT / "CHANGELOG.md").read_text("utf-8")
    unreleased = changelog.partition("## [Unreleased]")[2].partition("\n## [")[0]
    entries = re.findall(r"^- .*(?:\n .*)*", unreleased, re.MULTILINE)
    assert [entry for entry in entries if entry.count("\n") > 2] == []
    assert [line for line in unreleased.splitlines() if len(line) > 120] == []
    assert re.findall(r"^[^-# \n].*", unreleased, re.MULTILINE) == []
