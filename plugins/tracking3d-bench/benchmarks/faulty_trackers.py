"""Mask trackers that fail on purpose, to demonstrate the robustness of a batch; `VARIABLE` of plug-ins names this file.

``aborting`` ends its process in its third frame, every time. ``filling`` finds the disk full in its third frame, the
first time only: the system then refuses what any program is refused on a full disk.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Self

from pydantic import Field

from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.csrt import CsrtTracker

_FRAME = 2


class _Faulty(CsrtTracker, ABC):
    """``csrt`` until its third frame."""

    class Options(CsrtTracker.Options):
        """Those of ``csrt``."""

        note: str = Field("", description="File that says that it has ended badly before.")

    def __init__(self, options: Any) -> None:
        super().__init__(options)
        self._note, self._seen = options.note, 0

    @classmethod
    def from_options(cls, options: Any) -> Self:
        """See `CsrtTracker.from_options`."""
        return cls(options)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """See `CsrtTracker.init`."""
        self._seen = 0
        return super().init(frame, prompt)

    def step(self, frame: Frame) -> MaskEstimate:
        """See `CsrtTracker.step`; fails when it is time for that."""
        self._seen += 1
        if self._seen == _FRAME:
            self._fail()
        return super().step(frame)

    @abstractmethod
    def _fail(self) -> None:
        """End badly."""


class Aborting(_Faulty):
    """Ends its process as a native library does that finds itself broken."""

    def _fail(self) -> None:
        os.abort()


class Filling(_Faulty):
    """Lets the system refuse to write files longer than some bytes, once."""

    def _fail(self) -> None:
        import resource

        note = Path(self._note)
        if not note.exists():
            note.write_text("the disk was full\n")
            resource.setrlimit(resource.RLIMIT_FSIZE, (16, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
