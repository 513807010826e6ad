"""The Dockerfile, step by step and without docker."""

from __future__ import annotations

import fnmatch
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
BASE_IMAGE = 150e6
"""Bytes that python:3.12-slim takes, at most."""
LARGEST = 1.5e9


def stages() -> list[list[tuple[str, str]]]:
    """Each stage's instructions in order, lines joined."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.M).replace("\\\n", " ")
    found: list[list[tuple[str, str]]] = []
    for line in filter(None, map(str.strip, text.splitlines())):
        word, _, rest = line.partition(" ")
        if word == "FROM":
            found.append([])
        found[-1].append((word, " ".join(rest.split())))
    return found


def of_kind(stage: list[tuple[str, str]], word: str) -> list[str]:
    return [rest for one, rest in stage if one == word]


BUILD, FINAL = stages()


def copied() -> list[str]:
    return [source for rest in of_kind(BUILD, "COPY") for source in rest.split()[:-1]]


def context(folder: Path) -> Path:
    """What the build stage has in its folder after its COPY lines."""
    for source in copied():
        path = ROOT / source
        if path.is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(path, folder / source, ignore=ignore, symlinks=True)
        else:
            shutil.copy(path, folder / source)
    return folder


def test_what_is_copied_is_there_and_sent_to_docker():
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    for source in copied():
        assert (ROOT / source).exists(), source
        sent = True
        for rule in rules:
            if fnmatch.fnmatch(source, rule.removeprefix("!")):
                sent = rule.startswith("!")
        assert sent, f"{source} is kept back by .dockerignore"
    assert {rule.removeprefix("!") for rule in rules if rule.startswith("!")} == set(copied())


def test_both_stages_have_one_python_and_the_last_is_not_root():
    assert [of_kind(stage, "FROM")[0].split()[0] for stage in (BUILD, FINAL)] == ["python:3.12-slim"] * 2
    user = of_kind(FINAL, "USER")[-1]
    assert user not in ("root", "0")
    words = [word for word, _ in FINAL]
    assert "RUN" not in words[words.index("USER") :]
    [made] = of_kind(FINAL, "RUN")
    assert re.match(rf"useradd --create-home --uid [1-9]\d* {user} ", made)
    folder = of_kind(FINAL, "WORKDIR")[-1]
    assert f"mkdir {folder} && chown {user} {folder}" in made


def test_what_is_installed_is_on_the_path_and_is_what_starts():
    [taken] = of_kind(FINAL, "COPY")
    _, where, target = taken.split()
    assert where == target == "/opt/tracking3d"
    assert f"PATH={where}/bin:$PATH" in of_kind(FINAL, "ENV")[0]
    assert of_kind(FINAL, "ENTRYPOINT") == ['["tracking3d"]']
    assert "tracking3d" in PROJECT["scripts"]


def test_every_step_is_one_that_is_tried_here():
    starts = [shlex.split(rest)[:3] for rest in of_kind(BUILD, "RUN")]
    assert starts == [
        ["python", "-m", "venv"],
        ["pip", "--python", "/opt/tracking3d"],
        ["cd", "/opt/tracking3d/lib/python3.12/site-packages", "&&"],
    ]


def test_the_step_that_removes_what_no_run_needs_leaves_the_rest(tmp_path):
    [command] = [rest for rest in of_kind(BUILD, "RUN") if rest.startswith("cd ")]
    packages = tmp_path / "site-packages"
    keep = [
        "torch/__init__.py",
        "torch/testing/a.py",
        "torch/bin/torch_shm_manager",
        "torch/lib/libc10.so",
        "a/b.py",
    ]
    gone = [
        "torch/include/a.h",
        "torch/test/a",
        "torch/bin/protoc",
        "numpy/tests/a.py",
        "scipy/linalg/tests/a.py",
    ]
    for name in keep + gone:
        (packages / name).parent.mkdir(parents=True, exist_ok=True)
        (packages / name).touch()
    command = command.replace(command.split()[1], shlex.quote(str(packages)))
    subprocess.run(["bash", "-euc", command], check=True)
    left = sorted(path.relative_to(packages).as_posix() for path in packages.rglob("*") if path.is_file())
    assert left == sorted(keep)


@pytest.mark.slow
def test_the_package_is_installed_from_what_is_copied_and_starts(tmp_path):
    make, install, _ = of_kind(BUILD, "RUN")
    place, source = str(tmp_path / "environment"), tmp_path / "source"
    source.mkdir()
    context(source)
    subprocess.run([sys.executable, *shlex.split(make.replace("/opt/tracking3d", place))[1:]], check=True)
    words = shlex.split(install.replace("/opt/tracking3d", place))
    index = words.index("--extra-index-url")
    del words[index : index + 2]
    # What it depends on is here already; the step itself brings it along.
    here = Path(metadata.distribution("torch").locate_file(""))
    given = [sys.executable, "-m", *words, "--no-deps", "--no-index", "--no-build-isolation", "--quiet"]
    subprocess.run(given, cwd=source, check=True, env=os.environ | {"PYTHONPATH": str(here)})
    [packages] = (tmp_path / "environment/lib").glob("python*/site-packages")
    assert (packages / "tracking3d/config/ready_files/csrt-rgb.yaml").is_file()
    done = subprocess.run(
        [f"{place}/bin/tracking3d", "--version"],
        env={"PYTHONPATH": f"{packages}:{here}", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert PROJECT["version"] in done.stdout, done.stderr


@pytest.mark.slow
def test_what_the_image_holds_is_under_one_and_a_half_gigabytes():
    if "+cpu" not in metadata.version("torch"):
        pytest.skip("another build of torch is installed than the image has")
    wanted, sizes = [Requirement(one).name for one in PROJECT["dependencies"]], {}
    while wanted:
        name = wanted.pop().lower().replace("_", "-")
        if name in sizes:
            continue
        distribution = metadata.distribution(name)
        files = [
            file for file in distribution.files or [] if file.suffix != ".pyc" and not removed(file.parts)
        ]
        paths = [Path(distribution.locate_file(file)) for file in files]
        sizes[name] = sum(path.stat().st_size for path in paths if path.is_file())
        for text in distribution.requires or []:
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                wanted.append(requirement.name)
    own = sum(path.stat().st_size for path in (ROOT / "tracking3d").rglob("*") if path.suffix != ".pyc")
    assert sizes["torch"] > 1e8
    assert BASE_IMAGE + own + sum(sizes.values()) < LARGEST


def removed(parts: tuple[str, ...]) -> bool:
    if parts[:2] == ("torch", "bin"):
        return parts[-1] != "torch_shm_manager"
    return "tests" in parts or parts[:2] in {("torch", name) for name in ("include", "test", "share")}
