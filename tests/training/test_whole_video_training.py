"""The fit of the whole-video weights writes where the package reads them."""

from __future__ import annotations

from pathlib import Path

from script_folders import scripts_of

from tracking3d.estimation.segmentation import whole_video_weights

with scripts_of(Path(__file__).resolve().parents[2] / "training"):
    import hindsight_masks


def test_the_weights_are_written_into_the_module_that_holds_them():
    assert Path(whole_video_weights.__file__).resolve() == hindsight_masks._WEIGHTS
