"""What is uploaded to a package index: a source distribution, a wheel, and the page that it shows."""

from __future__ import annotations

import email
import importlib.util
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.message import Message
from pathlib import Path

import pytest
from documentation_pages import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
BUILD = """
import sys
from setuptools import build_meta
out = sys.argv[1]  # a build puts arguments of its own there
build_meta.build_sdist(out)
build_meta.build_wheel(out)
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with both distributions, built from a copy: a build leaves files behind."""
    checkout, out = (tmp_path_factory.mktemp(name) for name in ("checkout", "distributions"))
    left_out = (".*", "build", "demo", "runs", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, checkout, dirs_exist_ok=True, ignore=shutil.ignore_patterns(*left_out))
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(out)], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def sdist_names(built) -> set[str]:
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        return {name.partition("/")[2] for name in archive.getnames()}


@pytest.fixture(scope="module")
def wheel_names(built) -> set[str]:
    (path,) = built.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def metadata(built) -> Message:
    (path,) = built.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        return email.message_from_bytes(archive.read(name))


def files_of(folder: str) -> set[str]:
    return {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and not re.search(r"__pycache__|\.egg-info|/build/|/\.", path.as_posix())
    }


@pytest.mark.slow
def test_the_source_distribution_holds_the_project(sdist_names):
    single = {
        "README.md",
        "CHANGELOG.md",
        "CITATION.cff",
        "CONTRIBUTING.md",
        "Dockerfile",
        "LICENSE",
        "Makefile",
        "SECURITY.md",
        "constraints.txt",
        "mkdocs.yml",
        "setup.py",
    }
    names = (
        "benchmarks",
        "docs",
        "conda",
        "configs",
        "examples",
        "history",
        "tests",
        "plugins",
        "training",
        "tracking3d",
    )
    folders = [files_of(name) for name in names]
    assert sorted(single.union(*folders) - sdist_names) == []
    assert [name for name in sdist_names if "__pycache__" in name or name.endswith(".pyc")] == []


@pytest.mark.slow
def test_the_wheel_holds_the_package_with_its_data_and_nothing_else(wheel_names):
    assert sorted(files_of("tracking3d") - wheel_names) == []
    tops = {name.partition("/")[0] for name in wheel_names}
    assert tops == {"tracking3d", f"tracking3d-{PROJECT['version']}.dist-info"}


@pytest.mark.slow
def test_the_page_of_the_package_index_has_no_link_that_leads_nowhere(metadata):
    assert metadata["Description-Content-Type"] == "text/markdown"
    page = metadata.get_payload()
    assert page.lstrip().startswith("# tracking3d")
    targets = re.findall(r"\]\(([^)\s]+)\)", page)
    assert targets and all(target.startswith("https://") for target in targets)
    assert set(metadata.get_all("Project-URL")) == {f"{name}, {url}" for name, url in PROJECT["urls"].items()}
    assert "Operating System :: POSIX :: Linux" in metadata.get_all("Classifier")


def index_page(readme: str, source: str | None) -> str:
    specification = importlib.util.spec_from_file_location("setup_script", ROOT / "setup.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module.index_page(readme, source)


README = """See [the method](docs/method.md#lens), [docs/a.md](docs/a.md) and [it](https://a.org/b).
![An overlay](docs/images/a.jpg)
```python
frames[0](docs)
```
"""


def test_links_are_made_absolute_where_the_repository_has_an_address():
    page = index_page(README, "https://host.example/owner/name/")
    base = "https://host.example/owner/name"
    assert f"[the method]({base}/blob/HEAD/docs/method.md#lens)" in page
    assert f"![An overlay]({base}/raw/HEAD/docs/images/a.jpg)" in page
    assert "[it](https://a.org/b)" in page
    assert "frames[0](docs)" in page


def test_without_an_address_links_name_the_file_and_pictures_become_captions():
    page = index_page(README, None)
    assert "See the method (docs/method.md), docs/a.md and [it](https://a.org/b).\n*An overlay*\n" in page
    assert "frames[0](docs)" in page


def test_urls_of_the_project_are_stated_in_the_citation_too():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert [url for url in PROJECT["urls"].values() if url not in citation] == []
