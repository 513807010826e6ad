"""The recipe for conda-forge asks for what pyproject.toml asks for."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import jinja2
import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
OTHER_NAMES = {
    "torch": "pytorch",
    "opencv-contrib-python-headless": "py-opencv",
    "xatlas": "xatlas-python",
}
"""What conda-forge calls a package of the index."""


@pytest.fixture(scope="module")
def recipe() -> dict[str, Any]:
    text = (ROOT / "conda/recipe/meta.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(jinja2.Template(text, undefined=jinja2.StrictUndefined).render(PYTHON="python"))


def as_conda(requirement: str) -> str:
    parsed = Requirement(requirement)
    name = OTHER_NAMES.get(parsed.name, parsed.name.lower())
    return f"{name} {parsed.specifier}".strip()


def test_it_is_this_version_of_this_project(recipe):
    assert recipe["package"] == {"name": PROJECT["name"], "version": PROJECT["version"]}
    assert recipe["about"]["license"] == PROJECT["license"]
    assert (ROOT / recipe["about"]["license_file"]).is_file()
    assert recipe["build"]["noarch"] == "python"
    assert recipe["build"]["entry_points"] == [f"{a} = {b}" for a, b in PROJECT["scripts"].items()]
    assert (ROOT / "conda/recipe" / recipe["source"]["path"]).resolve() == ROOT


def test_it_needs_what_the_project_needs(recipe):
    python = f"python {PROJECT['requires-python']}"
    assert sorted(recipe["requirements"]["run"]) == sorted([python, *map(as_conda, PROJECT["dependencies"])])
    host = [python, "pip", *map(as_conda, PYPROJECT["build-system"]["requires"])]
    assert sorted(recipe["requirements"]["host"]) == sorted(host)


def test_what_it_tries_is_there(recipe):
    assert all(re.match(r"tracking3d( |$)", command) for command in recipe["test"]["commands"])
    for name in recipe["test"]["imports"]:
        assert (ROOT / name.replace(".", "/") / "__init__.py").is_file()
