"""Where a browser looks from at first."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is absent: pip install 'tracking3d[view]'")

from tracking3d.viewer.browser_camera import aside_of

RING = np.array([[np.sin(turn), 0, -np.cos(turn)] for turn in np.linspace(0, 6, 40)]) * 4


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 0, 2), (0, 2, 1)], ids=["level", "upright", "facing"])
def test_the_first_look_is_onto_the_plane_of_the_path_and_not_along_it(axes):
    path = RING[:, axes]
    aside, middle = aside_of(path)
    normal = np.abs(np.linalg.svd(path - path.mean(0))[2][2] @ aside)
    assert 0.7 < normal < 0.99, "onto it, but not flat"
    assert aside[1] < -0.1, "from above, for y points down"
    assert np.linalg.norm(middle) < 1


@pytest.mark.parametrize("path", [RING[:1], RING[:3]], ids=["one", "short"])
def test_a_path_of_next_to_no_length_is_looked_at_from_aside(path):
    aside, _ = aside_of(path)
    assert np.isfinite(aside).all()
    assert abs(aside @ [0, 0, 1]) < 0.5, "neither through the camera nor from behind the object"
