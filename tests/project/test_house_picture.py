"""The pictures of the rooms in CONTRIBUTING.md show the present imports."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def house():
    specification = importlib.util.spec_from_file_location("house", ROOT / "docs/images/house.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def picture(house) -> str:
    """It reads every module's imports."""
    return house.picture()


def test_the_picture_is_up_to_date(house, picture):
    drawn = house.PICTURE.read_text(encoding="utf-8")
    assert drawn == picture, "draw it again: python docs/images/house.py"


def test_every_room_is_in_it(house, picture):
    rooms = set().union(*house.architecture().FLOORS)
    assert rooms <= set(re.findall(r">([a-z_]+)</text>", picture))


def test_the_picture_of_the_online_solver_is_up_to_date_and_has_every_room(house):
    drawn = house.ONLINE_PICTURE.read_text(encoding="utf-8")
    assert drawn == house.online_picture(), "draw it again: python docs/images/house.py"
    rooms = set().union(*house.architecture().ONLINE_FLOORS)
    assert rooms <= set(re.findall(r">([a-z_]+)</text>", drawn))


def test_only_the_longest_paths_are_drawn(house):
    used = {"cli": {"results", "errors"}, "results": {"errors", "frames"}, "errors": set(), "frames": set()}
    assert house.longest_paths(used) == [("cli", "results"), ("results", "errors"), ("results", "frames")]


def test_levels_put_each_room_as_low_as_its_imports_allow(house):
    used = {"cli": {"results", "errors"}, "results": {"errors"}, "web": {"errors"}, "errors": set()}
    assert house.levels(used) == [{"errors"}, {"results", "web"}, {"cli"}]
