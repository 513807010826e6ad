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

from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.clip import read_truth

PAGE = ROOT / "docs/gallery.md"
SCRIPT = ROOT / "docs/images/gallery_things.py"
OWL, OWL_CLIP = ROOT / "docs/images/owl.py", ROOT / "docs/images/owl_clip.py"
NAMES = ("tin", "mug", "ball", "truck")


def script(file: Path = SCRIPT) -> ModuleType:
    specification = importlib.util.spec_from_file_location(file.stem, file)
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


@pytest.fixture(scope="module")
def owl_clip(tmp_path_factory) -> Path:
    """A clip of three frames of a coarse owl."""
    folder = tmp_path_factory.mktemp("clips") / "owl"
    owl = script(OWL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "owl", owl)
        patch.setattr(owl, "ROWS", 40)
        patch.setattr(owl, "COLUMNS", 80)
        patch.setattr(owl, "TEXELS", 128)
        clip = script(OWL_CLIP)
        patch.setattr(clip, "LIGHTS", 2)
        patch.setattr(sys, "argv", ["owl_clip.py", str(folder), "--frames", "3", "--size", "64", "48"])
        clip.main()
    return folder


def test_the_owl_is_a_closed_painted_surface(owl_clip):
    mesh = trimesh.load_mesh(owl_clip / "mesh.obj")
    assert 0.1 < mesh.extents.max() < 0.2
    assert mesh.volume > 0
    assert len(np.unique(np.asarray(mesh.visual.material.image).reshape(-1, 3), axis=0)) > 20


def test_the_camera_of_the_owl_stands_still_and_the_owl_turns_in_place(owl_clip):
    truth = read_truth(owl_clip)
    poses = np.stack([truth.T_cam_obj[n] for n in range(3)])
    np.testing.assert_allclose(poses[:, :3, 3], poses[:1, :3, 3].repeat(3, axis=0))
    np.testing.assert_allclose(poses[:, :3, 1], poses[:1, :3, 1].repeat(3, axis=0), atol=1e-9)  # upright
    turned = np.arccos((np.trace(poses[0, :3, :3].T @ poses[1, :3, :3]) - 1) / 2)
    assert np.degrees(turned) == pytest.approx(120, abs=4)
    images = np.stack([read_image(file) for file in sorted((owl_clip / "frames").iterdir())]).astype(int)
    masks = np.stack([mask.read() for _, mask in sorted(truth.masks.items())])
    beside = ~masks.any(axis=0)
    assert np.abs(images - images[0])[:, beside].mean() < 5 < np.abs(images[1] - images[0])[masks[0]].mean()


def test_every_clip_is_tracked_where_it_was_written():
    lines = commands(PAGE, "tracking3d")
    made = {line.split()[1] for line in lines if line.startswith("synth ")}
    made |= {
        line.split()[1] for line in commands(PAGE, "python") if line.startswith("docs/images/owl_clip.py ")
    }
    tracked = {line.split()[1].removesuffix("/frames") for line in lines if line.startswith("run ")}
    assert made == tracked and len(made) == len(NAMES) + 3  # the owl, and two videos of the blocks
