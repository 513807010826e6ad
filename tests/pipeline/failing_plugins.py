"""Plug-ins that fail in chosen frames; the tests register this file by the environment variable."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor

from tracking3d.errors import InputError
from tracking3d.frames import Frame, MaskEstimate, Prompt

Frames = tuple[int, ...]
Fault = str | dict[int, str]
"""How to fail, in every frame of ``at``, or in each of them."""


def fault_in(fault: Fault, place: int) -> str:
    return fault if isinstance(fault, str) else fault[place]


def there_and_back(index: int) -> int:
    """Of a clip of five frames that is shown again and again."""
    return min(index % 8, 8 - index % 8)


class FailingTracker:
    """Answers with the prompt's mask moved along, but fails in some frames in one way."""

    shown: ClassVar[int | None] = None
    """The frame that the latest of them was shown."""

    class Options(BaseModel):
        fault: Fault
        at: Frames

    @classmethod
    def from_options(cls, options: Options) -> FailingTracker:
        tracker = cls()
        tracker.options = options
        return tracker

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        self.mask = prompt.mask
        return self.step(frame)

    def step(self, frame: Frame) -> Any:
        FailingTracker.shown = frame.index
        mask = np.roll(self.mask, there_and_back(frame.index), axis=1).astype(np.float32)
        if frame.index not in self.options.at:
            return MaskEstimate(mask)
        match fault_in(self.options.fault, frame.index):
            case "raises":
                raise ZeroDivisionError("no pixels")
            case "exits":
                raise SystemExit(3)
            case "refuses":
                raise InputError("The third mask is missing.")
            case "says nothing":
                return None
            case "array":
                return mask
            case "shape":
                return MaskEstimate(np.ones((3, 4), np.float32))
            case "nan":
                return MaskEstimate(mask * math.nan)
            case "range":
                return MaskEstimate(mask * 255)
            case "list":
                return MaskEstimate(mask.tolist())
            case "score":
                return MaskEstimate(mask, math.nan)
        raise AssertionError(self.options.fault)


class FailingEncoder:
    """The colours, but fails in one way in some frames; in some calls, where another tracker than this file's runs.

    A solver may look at a frame more than once.
    """

    channels, stride, tau = 3, 1, 2.0

    class Options(BaseModel):
        fault: Fault
        at: Frames

    @classmethod
    def from_options(cls, options: Options) -> FailingEncoder:
        encoder = cls()
        encoder.options, encoder.calls = options, 0
        FailingTracker.shown = None
        if options.fault == "attribute":
            encoder.channels = 0
        return encoder

    def encode(self, images: Tensor) -> Any:
        place = self.calls if FailingTracker.shown is None else FailingTracker.shown
        self.calls += 1
        if place not in self.options.at:
            return images
        match fault_in(self.options.fault, place):
            case "raises":
                raise ZeroDivisionError("no channels")
            case "array":
                return images.numpy()
            case "channels":
                return images[:, :2]
            case "stride":
                return images[..., ::2, ::2]
            case "batch":
                return images[0]
            case "nan":
                return images * math.nan
            case "integers":
                return (images * 255).to(torch.uint8)
        raise AssertionError(self.options.fault)
