"""How likely each pixel is the object's, from sources that see different things, for any solver.

Of one frame, `pixel_features` says what the sources see, `log_odds` weighs it, `snap_to_edges` and `clean_mask` decide.
When all frames are known, `tracking3d.estimation.segmentation.whole_video` does the same with more sources.
"""

from tracking3d.estimation.segmentation.colour_models import ColourModels, as_lab
from tracking3d.estimation.segmentation.mask_extraction import clean_mask, paste_window, snap_to_edges
from tracking3d.estimation.segmentation.online_features import SOURCES, image_weight, log_odds, pixel_features
from tracking3d.estimation.segmentation.pose_weight import blend_with_initial, pose_weight

__all__ = [
    "SOURCES",
    "ColourModels",
    "as_lab",
    "blend_with_initial",
    "clean_mask",
    "image_weight",
    "log_odds",
    "paste_window",
    "pixel_features",
    "pose_weight",
    "snap_to_edges",
]
