"""Plug-ins that take a known time; the tests register this file by the environment variable."""

from __future__ import annotations

import time

import numpy as np
from pydantic import BaseModel
from torch import Tensor

from tracking3d.frames import Frame, MaskEstimate, Prompt

TRACKING, ENCODING = 0.06, 0.04  # seconds


class SleepingTracker:
    """Answers with the prompt's mask moved along, after a while."""

    class Options(BaseModel):
        pass

    @classmethod
    def from_options(cls, options: Options) -> SleepingTracker:
        return cls()

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        self.mask = prompt.mask
        return self.step(frame)

    def step(self, frame: Frame) -> MaskEstimate:
        time.sleep(TRACKING)
        return MaskEstimate(np.roll(self.mask, frame.index, axis=1).astype(np.float32))


class SleepingEncoder:
    """The colours, after a while."""

    channels, stride, tau = 3, 1, 0.05

    class Options(BaseModel):
        pass

    @classmethod
    def from_options(cls, options: Options) -> SleepingEncoder:
        return cls()

    def encode(self, images: Tensor) -> Tensor:
        time.sleep(ENCODING)
        return images
