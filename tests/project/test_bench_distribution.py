"""The second distribution, plugins/tracking3d-bench: made for this version, and whole."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BENCH = ROOT / "plugins/tracking3d-bench"
PROJECT, OWN = (
    tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for folder in (ROOT, BENCH)
)


def test_it_is_made_for_exactly_this_version():
    assert OWN["version"] == PROJECT["version"]
    assert OWN["dependencies"] == [f"{PROJECT['name']}=={PROJECT['version']}"]


def test_its_wheel_holds_every_module_layout_and_suite(tmp_path):
    checkout = tmp_path / "checkout"
    shutil.copytree(BENCH, checkout, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    build = "from setuptools import build_meta; build_meta.build_wheel('..')"
    subprocess.run([sys.executable, "-c", build], cwd=checkout, check=True, capture_output=True)
    [wheel] = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    package = BENCH / "tracking3d_bench"
    assert held == {
        path.relative_to(BENCH).as_posix()
        for path in package.rglob("*")
        if path.suffix in (".py", ".yaml", ".typed")
    }
