"""Finished runs to make pages of, and a browser to open them in."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from turning_sphere import turning_sphere_of, written_run

from tracking3d.estimation.estimate import MaskSource, Status
from tracking3d.results.run_reader import RunReader


@pytest.fixture(scope="session")
def written(tmp_path_factory) -> Path:
    """A run of twelve frames: three of them lost, two uncertain, one without an initial mask."""
    clip = turning_sphere_of(12)
    changes: dict[int, dict[str, Any]] = {
        **{n: {"status": Status.LOST, "reason": "out of sight", "confidence": 0.0} for n in (4, 5, 6)},
        **{n: {"status": Status.UNCERTAIN, "reason": f"loss 0.{n}", "confidence": 0.4} for n in (7, 8)},
        9: {"initial_mask": None},
    }
    estimates = [
        dataclasses.replace(
            estimate,
            mask_source=MaskSource.INITIAL if number in (4, 5, 6, 8) else MaskSource.RENDERED,
            **changes.get(number, {}),
        )
        for number, estimate in enumerate(clip.estimates)
    ]
    folder = tmp_path_factory.mktemp("written") / "sphere"
    written_run(folder, dataclasses.replace(clip, estimates=estimates))
    return folder


@pytest.fixture
def run_folder(written, tmp_path) -> Path:
    """A copy of that run that a test may damage."""
    return shutil.copytree(written, tmp_path / "sphere")


@pytest.fixture
def described() -> Callable[..., None]:
    """Change what ``run.json`` of a run says: ``described(folder, key=value, ...)``."""

    def change(folder: Path, **changes: Any) -> None:
        file = folder / "run.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))
        RunReader(folder)

    return change


@pytest.fixture(
    scope="module"
)  # no longer: what drives it runs an event loop, beside which asyncio.run refuses
def browser() -> Iterator[Any]:
    """A Chromium without a window; the test is skipped where there is none, or nothing to drive it with."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("there is no Chromium on this machine")
    driver = pytest.importorskip(
        "playwright.sync_api", reason="pip install 'tracking3d[browser]' drives Chromium"
    )
    with driver.sync_playwright() as playwright:
        opened = playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--enable-unsafe-swiftshader"]
        )
        yield opened
        opened.close()


@pytest.fixture
def make_turning_run(tmp_path) -> Callable[..., Path]:
    """Writes a run in which all is well, without a mesh: ``make_turning_run(frames, folder, **changes)``."""

    def make(frames: int, folder: Path | None = None, **changes: Any) -> Path:
        folder = folder or tmp_path / f"turning_{frames}"
        written_run(folder, turning_sphere_of(frames), with_model=False, **changes)
        return folder

    return make
