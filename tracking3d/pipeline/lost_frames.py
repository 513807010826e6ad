"""Before the final refinement: what can be done about frames in which the object was lost.

The model is extended over them from the frames around (`gap_tracker`). If too many are left, the video is tracked once
more from another frame (`second_start`), and whichever start explains more is refined.
"""

from __future__ import annotations

import logging

from tracking3d.estimation.estimate import UNALIGNED_MAP, Status
from tracking3d.pipeline.gap_tracker import GapTracker
from tracking3d.pipeline.saved_masks import SavedMasks
from tracking3d.pipeline.second_start import try_second_start
from tracking3d.pipeline.session import Session
from tracking3d.results.description import StartOfModel
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)

_MIN_LOST = 0.05  # share of the frames from which something is done


def explain_lost_frames(session: Session, source: FrameSource, masks: SavedMasks) -> StartOfModel:
    """Track the object into frames in which it was lost though the mask tracker saw it, if there are many.

    Args:
        session: The object after its last frame, before `Session.refine`.
        source: The video, which can be read again.
        masks: The causal estimates and their initial masks.

    Returns:
        Where the model that is to be refined started.
    """
    causal = masks.estimates.causal
    first = StartOfModel(session.first_index, "tracking began in this frame")
    lost = [index for index, one in causal.items() if one.status is Status.LOST and masks.has_mask(index)]
    if len(lost) < max(1, _MIN_LOST * len(causal)):
        return first
    gaps = GapTracker(session, source, masks)
    gaps.run({index: one.diagnostics.get(UNALIGNED_MAP, one.confidence) for index, one in causal.items()})
    second = try_second_start(session, source, masks, gaps)
    if second is None:
        return first
    compared = (
        f"frame {second.frame} explains {second.explained} of {len(causal)} frames, one in frame {first.frame} "
        f"explains {second.explained_before}"
    )
    _log.info("A start in %s.", compared)
    return StartOfModel(second.frame, f"a start in {compared}") if second.is_better else first
