"""The solver compares features in the space that the first mask chose."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tracking3d.config.loading import load_config
from tracking3d.estimation.feature_space import TAU
from tracking3d.estimation.paper.solver import PaperSolver
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera


class ManyChannels:
    """RGB repeated seven times: 21 channels of rank 3."""

    channels, stride, tau = 21, 1, 0.07

    @classmethod
    def from_options(cls, options):
        return cls()

    def encode(self, images):
        return images.repeat(1, 7, 1, 1)


@pytest.mark.parametrize(("limit", "channels", "tau"), [("4", 4, TAU), ("null", 21, 0.07), ("64", 21, 0.07)])
def test_the_texture_has_the_channels_that_are_kept(limit, channels, tau):
    config = load_config(
        preset="rerendering",
        overrides=[f"object.texture_channels={limit}", "object.texture_size=32", "solver.iterations=2",
                   "solver.pose_iterations=2", "crop.size=32"],
    )  # fmt: skip
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    mask = np.zeros((48, 64), np.float32)
    mask[12:36, 20:44] = 1
    solver = PaperSolver(config, Camera.from_fov(64, 48), ManyChannels())
    assert solver.tau == tau
    state, _ = solver.init(Frame(0, image), MaskEstimate(mask))
    state, estimate = solver.step(state, Frame(1, image), MaskEstimate(mask))
    assert state.texture.shape == (channels, 32, 32)
    assert (state.space is None) == (channels == 21)
    assert torch.isfinite(state.texture).all()
    assert np.isfinite(estimate.losses["appearance"])
