"""The picker's page for correcting one frame of an existing run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.picker.drawing import parse_object
from tracking3d.picker.server import PageProgress, Picker, ShownRun
from tracking3d.picker.session import PickingSession
from tracking3d.web.access import Access


@dataclass(frozen=True, eq=False)
class DrawnCorrection:
    """The drawing: a box if that is sufficient, else a mask."""

    frame: int  # index of the frame
    box: Box | None = None  # (x, y, width, height) in pixels, or None
    mask: NDArray[np.bool_] | None = None  # (H, W) bool, or None


class CorrectionPage(Picker):
    """Serves the page until it is closed.

    Args:
        session: The frames, and the tracker that makes the masks.
        name: What the object is called.
        present: Gives the run's mask ``(H, W)`` of a frame, or None.
        begin: Begins to correct the run; raises a `Tracking3dError` if it cannot.
        progress: How far that is.
        access: Where to listen, and whom to serve.
        port: The port, or the next one that is free; 0 for any.
    """

    def __init__(
        self,
        session: PickingSession,
        name: str,
        present: Callable[[int], NDArray[np.bool_] | None],
        begin: Callable[[DrawnCorrection], None],
        progress: Callable[[], PageProgress],
        access: Access,
        port: int,
    ) -> None:
        self._name, self._present, self._begin = name, present, begin
        super().__init__(session, lambda picked: ("", ""), access, port)
        self.run = ShownRun((), progress)

    def told(self, path: str) -> Any | None:
        """See `Picker.told`."""
        told = super().told(path)
        return told and {**told, "correcting": self._name}

    def order(self, path: str, body: bytes) -> tuple[Any, Callable[[], None]] | None:
        """See `Picker.order`: a mask to look at, or the correction; a run is not begun here.

        The mask of an empty drawing is the one that the run has. Paint starts from it.
        """
        if path not in ("/mask", "/correct"):
            return None
        drawn = parse_object(body)
        present = self._present(drawn.frame)
        if path == "/mask":
            run_mask = present if drawn.is_empty else None
            return self.show(
                self.session.mask(drawn, present) if run_mask is None else run_mask, drawn.colour
            )
        if drawn.is_empty:
            raise InputError("Nothing is drawn yet; mark the object in this frame.")
        if drawn.only_a_box:
            # The mask is made to see that one can be.
            self.session.mask(drawn)
            self._begin(DrawnCorrection(drawn.frame, box=drawn.box))
        else:
            self._begin(DrawnCorrection(drawn.frame, mask=self.session.mask(drawn, present)))
        return {}, lambda: None
