"""What the projects write: a text file with a box or a mask a frame, or a folder of masks."""

from __future__ import annotations

from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.trackers.mask_files import open_masks
from tracking3d.trackers.precomputed import PrecomputedMasks
from tracking3d.trackers.protocol import MaskTracker
from tracking3d.trackers.region_files import read_regions
from tracking3d.trackers.region_tracker import RegionTracker


def open_results(path: Path) -> MaskTracker:
    """The results at ``path`` as a mask tracker.

    Args:
        path: A text file, ``output/test/tracking_results/ostrack/CONFIG/SEQUENCE.txt`` or what the VOT toolkit has
            stored; or a folder, a video or a numpy file of masks, see `PrecomputedMasks`.

    Raises:
        InputError: If there is nothing there, or it cannot be read.
    """
    if not path.exists():
        raise InputError(
            f"There are no results of OSTrack at {path}; give its text file or a folder of masks."
        )
    if path.suffix.lower() in (".txt", ".csv"):
        return RegionTracker(read_regions(path), "OSTrack")
    return PrecomputedMasks(open_masks(path))
