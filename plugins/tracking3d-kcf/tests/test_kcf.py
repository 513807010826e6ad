"""The kcf plug-in keeps to the protocol, follows a disc, and refuses what KCF cannot start on."""

from __future__ import annotations

import numpy as np
import pytest
from tracking3d_kcf import KcfTracker

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.testing import check_tracker


def disc_at(x: int) -> tuple[Frame, np.ndarray]:
    rows, columns = np.mgrid[:120, :200]
    mask = (rows - 60) ** 2 + (columns - x) ** 2 < 30**2
    background = np.dstack([columns // 8 % 2 * 40, rows // 8 % 2 * 40, rows * 0 + 120])
    texture = np.dstack([rows * 0 + 220, (rows + columns - x) // 6 % 2 * 90, rows * 0])
    return Frame(0, np.where(mask[..., None], texture, background).astype(np.uint8), name="frame 0"), mask


def test_it_conforms() -> None:
    check_tracker(KcfTracker, frames=3)


def test_a_moving_disc_is_followed() -> None:
    tracker = KcfTracker.from_options(KcfTracker.Options())
    tracker.init(disc_at(50)[0], Prompt((20.0, 30.0, 60.0, 60.0)))
    for x in range(54, 90, 4):
        frame, truth = disc_at(x)
        mask = tracker.step(frame).binary
        assert mask is not None
        assert (mask & truth).sum() > 0.9 * (mask | truth).sum()


def test_a_box_that_kcf_cannot_start_on_is_refused() -> None:
    with pytest.raises(InputError, match="inside frame 0"):
        KcfTracker.from_options(KcfTracker.Options()).init(disc_at(50)[0], Prompt((-5.0, 0.0, 60.0, 60.0)))
