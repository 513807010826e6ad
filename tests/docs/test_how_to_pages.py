"""Each how-to page, from an empty folder with a video in it: what it says to type works, in its order."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from documentation_pages import HOW_TO, blocks, commands, label
from PIL import Image
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.video import VideoWriter

BOX = r"--box [\d,]+"
NEEDED = {"usdz": "pxr"}
"""What formats need that is no part of every installation."""


@pytest.fixture(scope="module")
def filmed():
    """A thing that turns, in few and small pictures."""
    return synthesize(SyntheticSpec(frames=8, size=(160, 120), degrees_per_frame=4, seed=3))


@pytest.mark.slow
@pytest.mark.parametrize("page", HOW_TO, ids=label)
def test_a_page_works_from_top_to_bottom(page: Path, filmed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = commands(page, "tracking3d")
    assert lines
    box = ",".join(f"{round(side)}" for side in filmed.box)
    for name in {name for line in lines for name in re.findall(r"[\w/]+\.mp4", line)}:
        film(filmed, Path(name))
    if any("run photos " in line for line in lines):
        photograph(filmed)
    for line in lines:
        line = re.sub(BOX, f"--box {box}", line)
        line = re.sub(r"(--correct \d+):[\d,]+", rf"\1:{box}", line)
        line = re.sub(r"--intrinsics [\d,]+", "--intrinsics 145,145,79.5,59.5", line)
        asked = re.search(r"--to (\S+)", line)
        if asked and asked[1] in NEEDED and importlib.util.find_spec(NEEDED[asked[1]]) is None:
            continue
        result = CliRunner().invoke(app, shlex.split(line))
        assert result.exit_code == 0, f"{line}\n{result.output}"
        if written := re.search(r"--out (\S+)", line):
            assert Path(written[1]).exists(), line
    program: dict = {"__name__": "documented"}
    for block in blocks(page, "python"):
        exec(compile(block, f"{label(page)}, a block", "exec"), program)


def film(clip, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with VideoWriter(path, 10, clip.images.shape[1:3]) as writer:
        for image in clip.images:
            writer.write(image)


def photograph(clip) -> None:
    """The frames and masks as folders of images."""
    for folder, images in ("photos", clip.images), ("masks", 255 * clip.masks.astype(np.uint8)):
        Path(folder).mkdir()
        for index, image in enumerate(images):
            Image.fromarray(image).save(f"{folder}/{index:02}.png")


def test_every_page_has_commands_and_says_what_comes_out():
    assert [page.stem for page in HOW_TO] == [
        "composite", "known-object", "robot-arm", "scan", "splat", "turntable-photos",
    ]  # fmt: skip
    for page in HOW_TO:
        lines = commands(page, "tracking3d")
        assert [line for line in lines if line.startswith("run ")], page
        assert all("--out" in line for line in lines if line.startswith(("run ", "export "))), page
