"""The picker's page for one frame of a run that is there: what the object is in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box
from tracking3d.picker.drawing import parse_object
from tracking3d.picker.server import Picker
from tracking3d.picker.session import PickingSession
from tracking3d.web.access import Access


@dataclass(frozen=True, eq=False)
class DrawnCorrection:
    """What was drawn: a box, where that says it all, else a mask.

    Attributes:
        frame: Index of the frame.
        box: ``(x, y, width, height)`` in pixels, or None.
        mask: ``(H, W)`` bool, or None.
    """

    frame: int
    box: Box | None = None
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class CorrectionProgress:
    """How far a correction is.

    Attributes:
        running: Whether it goes on.
        sentence: How far, or how it ended; empty where there was none.
        failed: Whether it ended without a result.
        share: Of the frames that are done, in [0, 1]; None where that is not known.
    """

    running: bool = False
    sentence: str = ""
    failed: bool = False
    share: float | None = None


class CorrectionPage(Picker):
    """Serves the page until it is closed.

    Args:
        session: The frames, and the tracker that makes the masks.
        name: What the object is called.
        begin: Begins to correct the run; raises a `Tracking3dError` where it cannot.
        progress: How far that is.
        access: Where to listen, and whom to answer.
        port: The port, or the next one that is free; 0 for any.
    """

    def __init__(
        self,
        session: PickingSession,
        name: str,
        begin: Callable[[DrawnCorrection], None],
        progress: Callable[[], CorrectionProgress],
        access: Access,
        port: int,
    ) -> None:
        self._name, self._begin, self._progress = name, begin, progress
        super().__init__(session, lambda picked: ("", ""), access, port)

    def told(self, path: str) -> Any | None:
        """See `Picker.told`."""
        if path == "/progress.json":
            now = self._progress()
            return {name: getattr(now, name) for name in ("running", "sentence", "failed", "share")}
        told = super().told(path)
        return told and {**told, "correcting": self._name}

    def ordered(self, path: str, body: bytes) -> tuple[Any, Callable[[], None]] | None:
        """See `Picker.ordered`: a mask to look at, or the correction; a run is not begun here."""
        if path == "/mask":
            return super().ordered(path, body)
        if path != "/correct":
            return None
        drawn = parse_object(body)
        if drawn.only_a_box:
            # The mask is made to see that one can be.
            self.session.mask(drawn)
            self._begin(DrawnCorrection(drawn.frame, box=drawn.box))
        else:
            self._begin(DrawnCorrection(drawn.frame, mask=self.session.mask(drawn)))
        return {}, lambda: None
