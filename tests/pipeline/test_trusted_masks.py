"""Initial masks that the user declares right come back as they are, causal and refined."""

from __future__ import annotations

import numpy as np
import pytest
from resumable_runs import settings

from tracking3d import Status
from tracking3d.pipeline.record import record
from tracking3d.results.files import write_mask
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.video import open_source

FRAMES = 14


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    """Large enough for a map to begin."""
    return synthesize(SyntheticSpec(frames=FRAMES, size=(160, 120), degrees_per_frame=4))


@pytest.fixture
def rough(clip, tmp_path):
    """A folder of masks that lack a strip at the bottom, another in every second frame."""
    (tmp_path / "masks").mkdir()
    for index, mask in enumerate(clip.masks):
        lowest = np.flatnonzero(mask.any(1))[-1]
        write_mask(
            tmp_path / "masks" / f"{index:03d}.png",
            mask & (np.arange(len(mask)) < lowest - 2 - 6 * (index % 2))[:, None],
        )
    return tmp_path / "masks"


def run(images, masks, out, *overrides) -> RunReader:
    config = settings(
        "tracker.name=precomputed", f"tracker.path={masks}", "object.texture_views=0", *overrides
    )
    record(open_source(str(images)), config, out)
    return RunReader(out)


def test_trusted_masks_come_back_in_causal_and_refined_estimates(images, rough, tmp_path):
    found = run(images, rough, tmp_path / "trusted", "object.trust_masks=true")
    usual = run(images, rough, tmp_path / "usual")
    assert any(frame.status is Status.TRACKED for frame in found.frames)
    for reader in (found, RunReader(tmp_path / "trusted", refined=False)):
        for frame in reader.frames:
            np.testing.assert_array_equal(reader.mask(frame.index), reader.initial_mask(frame.index))
    weights = [frame.diagnostics.get("mask_confidence", 1.0) for frame in found.frames]
    assert weights == [1.0] * FRAMES
    assert any((usual.mask(index) != usual.initial_mask(index)).any() for index in range(FRAMES))
