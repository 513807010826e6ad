"""``plugins new`` writes a package that works as it is: it conforms, passes its own test, and installs with pip."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tracking3d.errors import InputError, OutputError
from tracking3d.plugins import FEATURES, KEYPOINTS, TRACKERS, VARIABLE, list_plugins
from tracking3d.plugins.template import write_plugin

ROOT = Path(__file__).resolve().parents[2]
KINDS = pytest.mark.parametrize("kind", ["tracker", "features", "keypoints"])


def python(*arguments: object, cwd: Path, path: Path) -> str:
    """Call a fresh interpreter that finds packages in ``path``; what it prints."""
    result = subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join([str(path), str(ROOT)])},
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@KINDS
def test_a_new_package_has_everything_and_nothing_unfilled(tmp_path, kind):
    folder = write_plugin("my-own", kind, tmp_path)
    assert folder == tmp_path / "tracking3d-my-own"
    files = {
        path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()
    }
    module = "tracking3d_my_own"
    assert set(files) == {"pyproject.toml", "README.md", f"{module}/__init__.py", "tests/test_my_own.py"}
    for name, text in files.items():
        assert "$" not in text, name
        if name.endswith(".py"):
            ast.parse(text)
    project = tomllib.loads(files["pyproject.toml"])["project"]
    group, name = {
        "tracker": (TRACKERS, "MyOwnTracker"),
        "features": (FEATURES, "MyOwnEncoder"),
        "keypoints": (KEYPOINTS, "MyOwnDetector"),
    }[kind]
    assert project["entry-points"] == {group: {"my-own": f"{module}:{name}"}}
    assert "## Licence" in files["README.md"]


@pytest.mark.slow
def test_new_packages_pass_their_own_tests(tmp_path):
    folders = [write_plugin(f"my-{kind}", kind, tmp_path) for kind in ("tracker", "features", "keypoints")]
    path = Path(os.pathsep.join(map(str, folders)))
    result = python("-W", "error", "-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=tmp_path, path=path)
    assert "6 passed" in result


@KINDS
def test_a_new_plugin_is_registered_by_the_variable_that_its_readme_gives(tmp_path, monkeypatch, kind):
    folder = write_plugin("mine", kind, tmp_path)
    [line] = [line for line in (folder / "README.md").read_text().splitlines() if "export" in line]
    monkeypatch.setenv(VARIABLE, line.partition("=")[2].strip('"'))
    monkeypatch.chdir(folder)
    [info] = [info for info in list_plugins() if info.package == VARIABLE]
    assert (info.name, info.status, info.reason) == ("mine", "ok", "")


@pytest.mark.parametrize(
    "name",
    [
        "",
        "Mine",
        "my_own",
        "1st",
        "-mine",
        "mine-",
        "my--own",
        "my own",
        "../mine",
        "mine.py",
        "größe",
        "m" * 41,
    ],
)
def test_a_name_that_cannot_be_used_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"cannot be the name of a plug-in; .*such as my-tracker"):
        write_plugin(name, "tracker", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_taken_name_is_refused_within_its_kind_only(tmp_path):
    with pytest.raises(InputError, match=r"taken by the mask tracker 'csrt' \(tracking3d "):
        write_plugin("csrt", "tracker", tmp_path)
    assert write_plugin("csrt", "features", tmp_path).is_dir()


def test_a_folder_that_exists_is_left_alone(tmp_path):
    (tmp_path / "tracking3d-mine").mkdir()
    with pytest.raises(InputError, match="exists; choose another name"):
        write_plugin("mine", "tracker", tmp_path)
    assert list((tmp_path / "tracking3d-mine").iterdir()) == []


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_plugin("mine", "tracker", tmp_path / "file")


@pytest.mark.slow
@KINDS
def test_a_new_package_installs_with_pip_and_is_listed(tmp_path, kind):
    if any(importlib.util.find_spec(name) is None for name in ("pip", "setuptools")):
        pytest.skip("installing a package without the network needs pip and setuptools in this environment")
    folder, site = write_plugin("mine", kind, tmp_path), tmp_path / "site"
    options = ["--quiet", "--disable-pip-version-check", "--no-index", "--no-deps", "--no-build-isolation"]
    python("-m", "pip", "install", *options, "--target", site, folder, cwd=tmp_path, path=site)
    code = "from tracking3d.cli import main; main()"
    listed = json.loads(python("-c", code, "plugins", "--json", cwd=tmp_path, path=site))
    [info] = [info for info in listed if info["name"] == "mine"]
    assert (info["package"], info["version"], info["status"]) == ("tracking3d-mine", "0.1.0", "ok")
