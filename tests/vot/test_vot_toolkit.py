"""The VOT toolkit itself runs this tracker, where it is installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from sample_objects import QUICK, sample_clip

PYTHON_VARIABLE = "TRACKING3D_VOT_PYTHON"
"""Environment variable with the Python of an environment that has vot-toolkit and this package."""

PASSED = "Test concluded successfuly"
"""As the toolkit spells it; its exit code is 0 whatever happened."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def python() -> str:
    python = os.environ.get(PYTHON_VARIABLE, sys.executable)
    known = subprocess.run([python, "-c", "import vot, tracking3d"], capture_output=True, text=True)
    if known.returncode:
        pytest.skip(
            f"vot-toolkit is not installed; set {PYTHON_VARIABLE} to the Python of an environment with it"
        )
    return python


def vot_test(workspace: Path, python: str, tracker: str, *options: str) -> str:
    """What ``vot test`` prints for a tracker of the documented trackers.ini."""
    (workspace / "trackers.ini").write_text(
        f"""
[python]
protocol = python
command = tracking3d_bench.vot:VotTracker
timeout = 600
convert = rectangle
arg_overrides = {QUICK}

[trax]
protocol = trax
command = {python} -m tracking3d_bench.vot.trax_server --set "{QUICK}"
timeout = 600

[wrong]
protocol = python
command = tracking3d_bench.vot:VotTracker
arg_preset = no-such
"""
    )
    registry = str(workspace / "trackers.ini")
    run = subprocess.run(
        [python, "-m", "vot", "--registry", registry, "test", *options, tracker],
        env={**os.environ, "TMPDIR": str(workspace)},  # the toolkit writes its sequence there
        cwd=workspace,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
    )
    return run.stdout + run.stderr


def write_mask_sequence(folder: Path) -> Path:
    """Three frames in the toolkit's layout whose truth are masks."""
    clip = sample_clip()
    (folder / "color").mkdir(parents=True)
    lines = []
    for n, (image, mask) in enumerate(zip(clip.images, clip.masks, strict=True), 1):
        cv2.imwrite(str(folder / "color" / f"{n:08d}.jpg"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        x, y, width, height = cv2.boundingRect(mask.astype("uint8"))
        runs, inside = [0], False
        for value in mask[y : y + height, x : x + width].ravel():
            if value != inside:
                runs.append(0)
                inside = value
            runs[-1] += 1
        lines.append(f"m{x},{y},{width},{height}," + ",".join(map(str, runs)))
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    (folder / "sequence").write_text("channel.default=color\nformat=default\nfps=30\nname=masks\n")
    return folder


@pytest.mark.parametrize("protocol", ["python", "trax"])
def test_the_toolkits_test_of_three_objects_passes(python, tmp_path, protocol):
    output = vot_test(tmp_path, python, protocol)
    assert PASSED in output, output[-2000:]
    assert "49/49" in output


@pytest.mark.parametrize("protocol", ["python", "trax"])
def test_a_sequence_of_masks_passes(python, tmp_path, protocol):
    sequence = write_mask_sequence(tmp_path / "masks")
    output = vot_test(tmp_path, python, protocol, "--sequence", str(sequence))
    assert PASSED in output, output[-2000:]


def test_the_toolkit_is_told_what_is_wrong(python, tmp_path):
    output = vot_test(tmp_path, python, "wrong")
    assert PASSED not in output and "no-such" in output
