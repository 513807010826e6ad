"""How likely each pixel is the object's, from sources that see different things, for any solver.

Of one frame, `pixel_features` says what the sources see, `log_odds` weighs it, `snap_to_edges` and `clean_mask` decide.
When all frames are known, `tracking3d.segmentation.whole_video` does the same with more sources.
"""

from tracking3d.segmentation.colour_models import ColourModels, as_lab
from tracking3d.segmentation.mask_extraction import (
    clean_mask,
    hold_to_initial,
    paste_window,
    pose_share,
    snap_to_edges,
)
from tracking3d.segmentation.online_features import SOURCES, in_question, log_odds, pixel_features

__all__ = [
    "SOURCES",
    "ColourModels",
    "as_lab",
    "clean_mask",
    "hold_to_initial",
    "in_question",
    "log_odds",
    "paste_window",
    "pixel_features",
    "pose_share",
    "snap_to_edges",
]
