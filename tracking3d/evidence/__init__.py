"""How likely each pixel is the object's, from sources that see different things, for any solver.

Of one frame, `pixel_features` says what the sources see, `log_odds` weighs it, `along_edges` and `tidied` decide. When
all frames are known, `tracking3d.evidence.hindsight` does the same with more sources.
"""

from tracking3d.evidence.colours import Colours, as_lab
from tracking3d.evidence.decision import along_edges, pasted, tidied
from tracking3d.evidence.weighing import SOURCES, in_question, log_odds, pixel_features

__all__ = [
    "SOURCES",
    "Colours",
    "along_edges",
    "as_lab",
    "in_question",
    "log_odds",
    "pasted",
    "pixel_features",
    "tidied",
]
