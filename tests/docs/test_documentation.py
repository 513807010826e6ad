"""What the documentation names exists: files, headings, settings, keys of the files that are written."""

from __future__ import annotations

import re
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from documentation_pages import PAGES, ROOT, commands, label

from tracking3d.config.loading import list_presets, load_config
from tracking3d.config.models import OnlineConfig, PaperConfig, PipelineConfig
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.tracker_selection import CANDIDATES
from tracking3d.rendering import prepare_backend
from tracking3d.results import layout
from tracking3d.results.description import RunHeader, description_at_start, summary
from tracking3d.results.records import FrameRecord
from tracking3d.ui.picker.session import TRACKER_FOR
from tracking3d_bench.evaluation.score import Scores


def anchor(heading: str) -> str:
    """The anchor that Markdown viewers give a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_links_lead_somewhere(page: Path):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"https?:", target):
            continue
        name, _, fragment = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), target
        if fragment:
            headings = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.M)
            assert fragment in map(anchor, headings), target


def test_the_readme_shows_a_picture_before_anything_is_installed():
    first_screen = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n## ")[0]
    pictures = re.findall(r"!\[[^]]+\]\((docs/images/[^)]+)\)", first_screen)
    assert pictures
    assert sum((ROOT / picture).stat().st_size for picture in pictures) < 1_500_000


def test_the_readme_says_for_whom_it_is_and_begins_with_the_picker():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for_whom = readme.partition("\n## Is it for you?\n")[2].partition("\n## ")[0]
    assert "| | works | does not |" in for_whom
    for word in ("by hand", "on a table", "printed", "a third of the picture", "plain", "shiny", "soft"):
        assert word in for_whom, word
    assert [line.split()[0] for line in commands(ROOT / "README.md", "tracking3d")][:2] == ["pick", "run"]


def test_the_readme_installs_without_gigabytes_that_nobody_needs():
    [install, *_] = commands(ROOT / "README.md", "pip")
    assert "whl/cpu" in install


def test_figures_of_the_readme_say_when_they_were_measured():
    figures = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n## Figures\n")[2]
    lines = [line for line in figures.partition("\n## ")[0].splitlines() if line.startswith("- ")]
    assert lines and all(re.match(r"- \*\*.+\*\* \(\d{4}-\d\d-\d\d\): ", line) for line in lines)
    assert len(figures.partition("\n## ")[0].split()) < 250


def test_tables_of_the_benchmark_say_of_which_version_they_are():
    sections = (ROOT / "docs/benchmark.md").read_text(encoding="utf-8").split("\n## ")
    measured = [section for section in sections if "\n|---" in section]
    assert measured
    for section in measured:
        assert re.search(r"revision [0-9a-f]{7}, \d{4}-\d\d-\d\d", section), section.partition("\n")[0]


def test_there_is_a_page_for_who_is_lost():
    page = (ROOT / "docs/when-it-is-lost.md").read_text(encoding="utf-8")
    for subject in (
        "A moving camera",
        "Grey pictures",
        "One camera only",
        "Light that stays with the camera",
    ):
        assert re.search(rf"^- \*\*{subject}\*\*", page, re.M), subject
    for file in ("README.md", "docs/index.md", "docs/getting-started.md"):
        assert "when-it-is-lost.md" in (ROOT / file).read_text(encoding="utf-8"), file


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("KV-Tracker", "https://github.com/Marwan99/kv_tracker"),
        ("ProxyPose", "https://github.com/ruihangzhang97/proxypose"),
        ("OnlineSplatter", "https://arxiv.org/abs/2510.20605"),
        ("a turntable", "https://github.com/alicevision/AliceVision/pull/1943"),
        ("the two sides of an object", "https://github.com/alicevision/AliceVision/pull/1944"),
    ],
)
def test_alternatives_name_what_others_have_and_where_they_say_so(name, source):
    page = (ROOT / "docs/alternatives.md").read_text(encoding="utf-8")
    assert f"[{name}]({source}" in page


def test_every_page_is_in_the_index():
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    for page in ROOT.glob("docs/**/*.md"):
        name = page.relative_to(ROOT / "docs").as_posix()
        assert name == "index.md" or f"({name})" in index


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_settings_that_are_named_exist(page: Path):
    sections = "|".join(PipelineConfig.model_fields)
    named = re.findall(rf"`((?:{sections})\.[a-z_.]+)`", page.read_text(encoding="utf-8"))
    for path in set(named) - {layout.FEATURES}:
        reduce(field_named, path.split("."), PipelineConfig)


def field_named(model: Any, key: str) -> Any:
    """The type of a field; if several solvers have it, any of their types."""
    models = [one for one in (model, *get_args(model)) if hasattr(one, "model_fields")]
    found = [one.model_fields[key].annotation for one in models if key in one.model_fields]
    assert found, f"{model} has no {key}"
    return reduce(or_, found)


@pytest.mark.parametrize("preset", [name for name in list_presets() if name != "paper"])
def test_page_of_the_paper_lists_exactly_what_a_preset_changes(preset):
    page = (ROOT / "docs/method/paper.md").read_text(encoding="utf-8")
    section = re.search(
        rf"^#+ What (?:the {preset} preset|preset {preset}) changes\n(.*?)^#", page, re.M | re.S
    )
    assert section
    rows = re.findall(r"^\| `([a-z_.]+)` \| ([^|]*) \| ([^|]*) \|[^|]*\|$", section[1], re.M)
    documented = {key: (yaml.safe_load(before), yaml.safe_load(after)) for key, before, after in rows}
    paper, changed = (dict(flat(load_config(preset=name).model_dump())) for name in ("paper", preset))
    common = paper.keys() & changed.keys()
    assert documented == {key: (paper[key], changed[key]) for key in common if paper[key] != changed[key]}


def test_configuration_names_every_preset_and_every_key_of_the_solvers():
    page = (ROOT / "docs/configuration.md").read_text(encoding="utf-8")
    solvers = [dict(flat(model().model_dump())) for model in (OnlineConfig, PaperConfig)]
    keys = [f"solver.{key}" for settings in solvers for key in settings]
    assert [name for name in [*list_presets(), *keys] if f"`{name}`" not in page] == []


def flat(settings: dict[str, Any], prefix: str = ""):
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


@pytest.mark.parametrize("page", ["README.md", "docs/masks.md", "docs/how-to/scan.md"])
def test_every_page_that_says_which_tracker_to_take_says_the_same(page):
    table = re.search(
        r"^\| what you film, or have \| `--tracker` \|\n\|---\|---\|\n((?:\|.*\n)+)",
        (ROOT / page).read_text(encoding="utf-8"),
        re.M,
    )
    assert table
    assert table[1].splitlines() == [f"| {what} | `{name}` |" for name, what in TRACKER_FOR.items()]


def test_the_page_on_masks_has_the_costs_that_auto_goes_by():
    page = (ROOT / "docs/masks.md").read_text(encoding="utf-8")
    section = page.partition("### auto")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (.+?) \| (\.\d{3}) \| ([\d.]+) \| .*\|$", section, re.M)
    told = [(what, float(iou), float(seconds)) for what, iou, seconds in rows]
    names = {"segment": "`segment`", "csrt": "`csrt`", "flow": "`flow`"}
    assert told == [(names.get(one.name, one.what), one.iou, one.seconds) for one in CANDIDATES]


def test_run_folder_page_names_every_file_and_key():
    page = (ROOT / "docs/run-folder.md").read_text(encoding="utf-8")
    names = [value for name, value in vars(layout).items() if name.isupper() and isinstance(value, str)]
    files = [value for value in names if value.isprintable()]  # what sentences call arguments is not
    renderer = prepare_backend("auto", "cpu")
    start = description_at_start(
        RunHeader(
            config={},
            camera=Camera.from_fov(4, 4),
            source="",
            seed=0,
            fps=None,
            command=None,
            renderer=renderer,
        )
    )
    end = summary([], 0, {})
    keys = {
        *start,
        *start["versions"],
        *start["camera"],
        *start["renderer"],
        *end,
        *end["counts"],
        *end["timings"],
    }
    for name in {*files, *keys, *FrameRecord.__dataclass_fields__} - {layout.FORMAT}:
        assert name in page, name


def test_measures_page_names_every_key():
    page = (ROOT / "plugins/tracking3d-bench/benchmarks/measures.md").read_text(encoding="utf-8")
    assert [key for key in Scores.__dataclass_fields__ if f"`{key}`" not in page] == []
