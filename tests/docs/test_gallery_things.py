"""What the gallery films is made by a script of the repository, and is what its page says."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
from documentation_pages import ROOT, commands

PAGE = ROOT / "docs/gallery.md"
SCRIPT = ROOT / "docs/images/gallery_things.py"
NAMES = ("tin", "mug", "ball", "truck")


def script() -> ModuleType:
    specification = importlib.util.spec_from_file_location(SCRIPT.stem, SCRIPT)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def things(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("things")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["gallery_things.py", str(folder)])
        script().main()
    return folder


def test_the_page_films_what_the_script_makes(things):
    named = re.findall(r"things/(\w+)\.glb", PAGE.read_text(encoding="utf-8"))
    assert set(named) == {path.stem for path in things.glob("*.glb")} == set(NAMES)
    assert [path.name for path in (things / "rooms").iterdir()] == ["room.png"]


@pytest.mark.parametrize("name", NAMES)
def test_a_thing_is_of_its_size_in_metres_and_shows_its_print_outside(things, name):
    [mesh] = trimesh.load_scene(things / f"{name}.glb").geometry.values()
    assert 0.1 < mesh.extents.max() < 0.2
    assert mesh.visual.uv.min() >= 0 and mesh.visual.uv.max() <= 1
    assert len(np.unique(np.asarray(mesh.visual.material.baseColorTexture).reshape(-1, 3), axis=0)) > 20
    if name != "mug":  # whose inside is seen, too
        assert mesh.volume > 0


def test_every_clip_is_tracked_where_it_was_written():
    lines = commands(PAGE, "tracking3d")
    made = {line.split()[1] for line in lines if line.startswith("synth ")}
    tracked = {line.split()[1].removesuffix("/frames") for line in lines if line.startswith("run ")}
    assert made == tracked and len(made) == len(NAMES)
