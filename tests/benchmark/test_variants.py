"""A variant changes what it says and nothing else, and its masks can be meant."""

from __future__ import annotations

import pytest

from tracking3d.benchmark.variant import Variant, check_masks, degraded_iou
from tracking3d.config.loading import load_config
from tracking3d.errors import InputError


def test_a_changed_setting_is_the_only_change():
    base = Variant(label="base", config=load_config())
    changed = base.changed("no motion", solver__weights__motion=0.0, masks="degraded:0.7")
    expected = load_config(overrides=["solver.weights.motion=0"])
    assert (changed.label, changed.masks, changed.config) == ("no motion", "degraded:0.7", expected)
    assert base.config == load_config()


@pytest.mark.parametrize("masks", ["degraded:", "degraded:1.2", "degraded:0.1", "degraded:nan", "nowhere"])
def test_masks_that_cannot_be_meant_are_refused(masks):
    with pytest.raises(InputError, match=f"The masks '{masks}'"):
        check_masks(masks)


def test_masks_that_can_be_meant_are_not(tmp_path):
    for masks in ("tracker", "truth", "initial", "degraded:0.73", str(tmp_path)):
        check_masks(masks)
    assert degraded_iou("degraded:0.73") == 0.73
