"""Memory depends on the keyframes, not on the length of the video."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.frames import Frame, Prompt
from tracking3d.pipeline.track import SOLVERS, Session
from tracking3d.runtime.memory import resident_memory
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize

FRAMES, SETTLED = 3000, 300
ALLOWED = 15.0
"""Megabytes by which memory may vary after the first 300 frames; an image kept of every frame would be 56."""

PRESETS = {"online": "default", "paper": "rerendering"}
QUICK = ["crop.size=32", "object.texture_size=64"]
OF_PAPER = ["solver.iterations=2", "solver.pose_iterations=2", "solver.init_frames=1"]

TRACKER = '''
import numpy as np
from pydantic import BaseModel

from tracking3d.frames import MaskEstimate


class Known:
    """Answers with the masks of a clip that is played to and fro."""

    class Options(BaseModel):
        path: str

    def __init__(self, options):
        self.masks = np.load(options.path).astype(np.float32)

    @classmethod
    def from_options(cls, options):
        return cls(options)

    def init(self, frame, prompt):
        return self.step(frame)

    def step(self, frame):
        period = 2 * (len(self.masks) - 1)
        place = frame.index % period
        return MaskEstimate(self.masks[min(place, period - place)])
'''


@pytest.mark.slow
@pytest.mark.parametrize("solver", sorted(SOLVERS))
def test_memory_is_flat_over_three_thousand_frames(solver, tmp_path, monkeypatch):
    clip = synthesize(SyntheticSpec(frames=61, size=(96, 72), supersample=1))
    np.save(tmp_path / "masks.npy", clip.masks)
    (tmp_path / "known.py").write_text(TRACKER)
    monkeypatch.setenv("TRACKING3D_PLUGINS", f"tracking3d.trackers:known={tmp_path / 'known.py'}:Known")
    config = load_config(
        preset=PRESETS[solver],
        overrides=QUICK + OF_PAPER * (solver == "paper"),
        tracker={"name": "known", "path": str(tmp_path / "masks.npy")},
    )
    session = Session(config, Prompt((0.0, 0.0, 96.0, 72.0)))
    last = len(clip.images) - 1
    held = []
    for index in range(FRAMES):
        place = index % (2 * last)
        session.step(Frame(index, clip.images[min(place, 2 * last - place)], time=index / 30))
        if index >= SETTLED and index % 100 == 0:
            gc.collect()
            held.append(resident_memory()[0])
    assert max(held) - held[0] < ALLOWED, f"memory every 100 frames from the 300th on: {held}"
