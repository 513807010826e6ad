"""The first mask by colours in a box: where they show no outline, one sentence says so."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.frames import Frame, Prompt
from tracking3d.trackers.csrt import CsrtTracker
from tracking3d.trackers.segment.tracker import SegmentTracker

BOX = (50.0, 40.0, 50.0, 40.0)


@pytest.mark.parametrize("kind", [CsrtTracker, SegmentTracker])
@pytest.mark.parametrize("outline", [False, True])
def test_a_box_in_which_no_outline_is_found_is_told_at_once(kind, outline, caplog):
    image = np.zeros((120, 160, 3), np.uint8)
    if outline:
        image[45:75, 55:95] = 220, 90, 30
    tracker = kind.from_options(kind.Options())
    tracker.init(Frame(0, image), Prompt(BOX))
    told = [record.message for record in caplog.records]
    assert len(told) == (0 if outline else 1)
    assert outline or (told[0].startswith("No outline was found in the box") and "--mask" in told[0])
    mask = np.zeros((120, 160), bool)
    mask[45:75, 55:95] = True
    caplog.clear()
    tracker.init(Frame(0, image), Prompt(BOX, mask))
    assert not caplog.records
