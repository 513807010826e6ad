"""Two tiny clips with exact truth, and a tracker that follows nothing but a script."""

from __future__ import annotations

import shutil

import pytest

from tracking3d.config.loading import load_config
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize, write_clip
from tracking3d_bench.benchmark.variant import Variant

QUICK = ["crop.size=32", "object.frequency=2", "camera.fov=45"]

TRACKER = '''
import os
import signal

import numpy as np
from pydantic import BaseModel

from tracking3d.frames import MaskEstimate


class Scripted:
    """Answers with a box; ends its process by a signal, or says that it fails, in frames that are wide enough."""

    class Options(BaseModel):
        crash: int = 10**6
        fail: int = 10**6

    def __init__(self, options):
        self.options = options

    @classmethod
    def from_options(cls, options):
        return cls(options)

    def init(self, frame, prompt):
        if frame.size[1] >= self.options.crash:
            os.kill(os.getpid(), signal.SIGSEGV)
        if frame.size[1] >= self.options.fail:
            raise RuntimeError("this tracker fails")
        x, y, width, height = (round(side) for side in prompt.box)
        self.mask = np.zeros(frame.size, np.float32)
        self.mask[y : y + height, x : x + width] = 1
        return MaskEstimate(self.mask)

    def step(self, frame):
        return MaskEstimate(self.mask)
'''


@pytest.fixture(scope="session")
def two_clips(tmp_path_factory):
    """What `clips` is a copy of."""
    folder = tmp_path_factory.mktemp("two") / "clips"
    for name, width in (("narrow", 64), ("wide", 72)):
        clip = synthesize(SyntheticSpec(frames=3, size=(width, 48), supersample=1))
        poses, camera = clip.T_cam_obj, clip.camera
        write_clip(folder / name, clip.images, clip.masks, poses, camera, source="test", note="")
    return folder


@pytest.fixture
def clips(two_clips, tmp_path):
    """A folder of two clips: ``narrow``, 64 pixels wide, and ``wide``, 72; a test may change it."""
    return shutil.copytree(two_clips, tmp_path / "clips")


@pytest.fixture
def scripted(tmp_path, monkeypatch):
    """Make a variant with the scripted tracker and a few quick iterations."""
    file = tmp_path / "scripted_tracker.py"
    file.write_text(TRACKER)
    monkeypatch.setenv("TRACKING3D_PLUGINS", f"tracking3d.trackers:scripted={file}:Scripted")

    def make(label="scripted", masks="tracker", **options) -> Variant:
        config = load_config(overrides=QUICK, tracker={"name": "scripted", **options})
        return Variant(label=label, config=config, masks=masks)

    return make
