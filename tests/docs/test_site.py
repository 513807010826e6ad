"""The documentation as a site: every page is in it, and it asks nobody else for anything."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from documentation_pages import HISTORY, ROOT, label


class WithPythonNames(yaml.SafeLoader):
    """mkdocs.yml names functions of Python; here they are their names."""


WithPythonNames.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: suffix)


@pytest.fixture(scope="module")
def site() -> dict[str, Any]:
    return yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), WithPythonNames)


def pages_of(nav: list[Any]) -> Iterator[str]:
    for entry in nav:
        for target in entry.values():
            yield from [target] if isinstance(target, str) else pages_of(target)


def titled(nav: list[Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Each page of the navigation, with its title below those of its sections."""
    for entry in nav:
        for title, target in entry.items():
            inner = f"{above}{title}"
            yield from [(inner, target)] if isinstance(target, str) else titled(target, f"{inner}: ")


def test_every_page_is_in_the_navigation_once(site):
    pages = sorted(path.relative_to(ROOT / "docs").as_posix() for path in ROOT.glob("docs/**/*.md"))
    assert sorted(pages_of(site["nav"])) == pages


def words(page: Path) -> int:
    """The words of a page as it lies in the repository, code and tables included, without their rules."""
    return sum(any(map(str.isalnum, word)) for word in page.read_text(encoding="utf-8").split())


def test_the_site_is_read_in_an_afternoon():
    counted = {page.relative_to(ROOT).as_posix(): words(page) for page in ROOT.glob("docs/**/*.md")}
    most = sorted(counted.items(), key=lambda page: -page[1])[:5]
    assert sum(counted.values()) <= 40_000, (
        f"the longest are {most}; what was measured before goes to history/"
    )


def test_history_is_beside_the_site(site):
    assert HISTORY and not list(ROOT.glob("docs/history"))
    assert not any("history" in target for target in pages_of(site["nav"]))


@pytest.mark.parametrize("page", HISTORY, ids=label)
def test_links_of_history_lead_to_files(page):
    targets = re.findall(r"\]\(([^)\s#]+)", page.read_text(encoding="utf-8"))
    assert [one for one in targets if not one.startswith("http") and not (page.parent / one).exists()] == []


def test_there_is_one_page_on_a_subject(site):
    titles = [title for title, _ in titled(site["nav"])]
    assert len(titles) == len(set(titles))
    headings = [page.read_text(encoding="utf-8").partition("\n")[0] for page in ROOT.glob("docs/*.md")]
    assert len(headings) == len(set(headings))
    assert not {"many-videos.md", "feature-networks.md"} & set(pages_of(site["nav"]))


def test_the_reference_names_what_there_is():
    page = (ROOT / "docs/reference.md").read_text(encoding="utf-8")
    names = re.findall(r"^::: (\S+)$", page, re.M)
    assert len(names) > 20
    for name in names:
        module, _, attribute = name.rpartition(".")
        if importlib.util.find_spec(module + "." + attribute if module == "tracking3d" else module) is None:
            pytest.fail(name)
        if module != "tracking3d":
            assert getattr(importlib.import_module(module), attribute).__doc__, name


def nameless_arguments(text: str) -> list[str]:
    """The lines of a docstring's list of arguments, attributes or errors that do not say of what they speak."""
    lists = re.findall(r"^(?:Args|Attributes|Raises):\n((?:[ ]{4}.*\n?|\n(?=[ ]{4}))+)", text, re.M)
    lines = [line[4:] for part in lists for line in part.splitlines() if not line.startswith(" " * 5)]
    return [line for line in lines if line.strip() and not re.match(r"[*\w., ]+( \([^)]*\))?: ?", line)]


def test_docstrings_name_each_argument_on_a_line_of_its_own():
    documented = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    at_fault = {
        f"{file.relative_to(ROOT)}: {node.name}": lines
        for file in sorted((ROOT / "tracking3d").rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, documented) and (lines := nameless_arguments(ast.get_docstring(node) or ""))
    }
    assert at_fault == {}


def hook(site: dict[str, Any], name: str) -> ModuleType:
    [path] = [ROOT / hook for hook in site["hooks"] if Path(hook).stem == name]
    specification = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_links_out_of_the_documentation_lead_to_the_repository_or_nowhere(site):
    with_links = hook(site, "page_text").with_links
    text = "See [the kcf](../plugins/kcf/README.md), [masks](../masks.md#auto) and [it](https://a.org)."
    assert with_links(text, "docs/how-to", None) == text  # both are pages' neighbours there
    told = with_links("[`kcf`](../plugins/kcf/README.md) and [masks](masks.md)", "docs", None)
    assert told == "`kcf` and [masks](masks.md)"
    assert with_links("[a](../b.py)", "docs", "https://h.org/o/r/") == "[a](https://h.org/o/r/blob/HEAD/b.py)"


def test_what_belongs_to_an_item_is_indented_as_markdown_here_wants_it(site):
    four = hook(site, "page_text").with_four_spaces
    assert (
        four("1. Run:\n\n   ```console\n   $ a\n   ```\n") == "1. Run:\n\n    ```console\n    $ a\n    ```\n"
    )
    assert four("```text\n   a\n```\n") == "```text\n   a\n```\n"


def test_equations_become_what_browsers_draw_by_themselves(site):
    pytest.importorskip("latex2mathml", reason="the extra `docs` is not installed")
    drawn = hook(site, "equations").on_page_content(r'<p><span class="arithmatex">\(a_1 &lt; b\)</span></p>')
    assert drawn.startswith("<p><math") and "<msub>" in drawn and "&lt;" in drawn.replace("&#x0003C;", "&lt;")


@pytest.mark.slow
def test_the_site_is_built_without_a_broken_link_and_fetches_nothing(tmp_path):
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    built = sorted((tmp_path / "site").rglob("*.html"))
    assert len(built) > 30
    for page in built:
        text = page.read_text(encoding="utf-8")
        assert re.findall(r"<(?:script|img|iframe|source)[^>]+src=\"?https?:[^>]*", text) == [], page.name
        assert re.findall(r"<link(?![^>]*rel=\"?canonical)[^>]+href=\"?https?:[^>]*", text) == [], page.name
        assert "arithmatex" not in text, page.name
    reference = (tmp_path / "site/reference.html").read_text(encoding="utf-8")
    assert 'id="tracking3d.pipeline.track.track"' in reference
