"""The picture of the data flow in docs/method.md is the one that its script makes, and its stages have pages."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs/method"
NO_STAGES = {"confidence", "paper", "segmentation"}
"""Pages about what several stages share, and about the other solver."""


@pytest.fixture(scope="module")
def data_flow():
    specification = importlib.util.spec_from_file_location("data_flow", ROOT / "docs/images/data_flow.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules["data_flow"] = module  # dataclasses look it up
    specification.loader.exec_module(module)
    yield module
    del sys.modules["data_flow"]


def test_the_picture_is_up_to_date(data_flow):
    drawn = data_flow.PICTURE.read_text(encoding="utf-8")
    assert drawn == data_flow.picture(), "draw it again: python docs/images/data_flow.py"


def test_the_method_begins_with_it():
    page = (ROOT / "docs/method.md").read_text(encoding="utf-8")
    assert "(images/data_flow.svg)" in page.partition("\n## ")[0]


def test_every_page_of_the_method_is_a_stage_or_says_why_not(data_flow):
    pages = {path.stem for path in PAGES.glob("*.md")}
    assert {stage.page for stage in data_flow.STAGES if stage.page} == pages - NO_STAGES
    assert pages >= NO_STAGES
