"""Before the final refinement: what can be done about frames in which the object was lost, or if nothing started.

The model is extended over them from the frames around (`gap_tracker`). If too many are left, the video is tracked once
more from another frame (`second_start`), and whichever start explains more is refined. Images that follow each other in
wide steps, or in no order, are joined as photos.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from dataclasses import replace

from tracking3d.estimation.estimate import UNALIGNED_MAP, Status
from tracking3d.estimation.gap import PhotoSet
from tracking3d.frames import TRACKED_CONFIDENCE, Frame, MaskEstimate
from tracking3d.pipeline.frame_reading import read_again
from tracking3d.pipeline.gap_tracker import GapTracker
from tracking3d.pipeline.saved_masks import SavedMasks
from tracking3d.pipeline.second_start import try_second_start
from tracking3d.pipeline.session import Session
from tracking3d.results.description import StartOfModel
from tracking3d.runtime.progress import report_progress
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)

_MIN_LOST = 0.05  # share of the frames from which something is done
_MIN_TRACKED = 0.5  # share of a photo set below which its start is doubted
_MIN_PHOTOS = 4  # photos with a mask


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
    advice = ""
    if needs_photo_start(session, source, masks):
        started, advice = start_from_photos(session, source, masks)
        if started is not None:
            return started
    first = replace(first, advice=advice if source.fps is None else "")
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
    return StartOfModel(second.frame, f"a start in {compared}", first.advice) if second.is_better else first


def needs_photo_start(session: Session, source: FrameSource, masks: SavedMasks) -> bool:
    """Whether there is no map with points, or too few images without times are `tracked`.

    A video that is too short for a map may get one at its end, and keeps it.
    """
    causal = masks.estimates.causal
    if sum(masks.has_mask(index) for index in causal) < _MIN_PHOTOS:
        return False
    tracked = sum(one.status is Status.TRACKED for one in causal.values())
    if source.fps is None and tracked < _MIN_TRACKED * len(causal):
        return True
    return session.lacks_points(ended=source.fps is not None)


def start_from_photos(
    session: Session, source: FrameSource, masks: SavedMasks
) -> tuple[StartOfModel | None, str]:
    """Join all frames as photos, and continue with that map if it explains more than what there is.

    Returns:
        Where the model started, None if it stays; and which photos are not joined, in words.
    """
    causal = masks.estimates.causal

    def read(indices: Collection[int]) -> Iterator[tuple[Frame, MaskEstimate]]:
        wanted = frozenset(indices)
        return masks.with_masks(frame for frame in read_again(source) if frame.index in wanted)

    report_progress("joining photos")
    seen = tuple(sorted(index for index in causal if masks.has_mask(index)))
    attempt, advice = session.start_from_photos(PhotoSet(seen, read))
    if attempt is None:
        return None, advice
    before = sum(one.status is Status.TRACKED for one in causal.values())
    explained = sum(one >= TRACKED_CONFIDENCE for one in attempt.confidence.values())
    _log.info("Photos joined: %d of %d frames explained, %d before.", explained, len(causal), before)
    if explained <= before:
        return None, ""
    session.adopt(attempt)
    reason = f"frames joined as photos explain {explained} of {len(causal)}, those before {before}"
    return StartOfModel(min(attempt.poses), reason, advice), advice
