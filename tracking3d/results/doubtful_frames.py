"""The uncertain and lost frames of a run, those in a row together, and why."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from tracking3d.estimation.estimate import Status
from tracking3d.results.records import FrameRecord

_FIGURES = re.compile(r"[\d.]+")


@dataclass(frozen=True)
class DoubtfulRange:
    """Frames in a row that are all uncertain, or all lost."""

    position: int  # position of the first frame among the estimates
    first: int  # its index in the source
    last: int  # index of the last frame
    count: int  # number of frames
    status: Status  # what they share
    # Why; several reasons with the number of frames of each, the commonest first. Figures in a reason are those of
    # its first frame.
    reason: str

    @property
    def frames(self) -> str:
        """Which frames, in words."""
        return f"frame {self.first}" if self.count == 1 else f"frames {self.first} to {self.last}"


def doubtful_ranges(records: Sequence[FrameRecord]) -> list[DoubtfulRange]:
    """The uncertain and lost frames of a run.

    Args:
        records: The estimate for every frame, in order.
    """
    found = []
    for status, numbered in groupby(enumerate(records), key=lambda one: one[1].status):
        if status is Status.TRACKED:
            continue
        (position, first), *others = numbered
        members = [first, *(record for _, record in others)]
        found.append(
            DoubtfulRange(position, first.index, members[-1].index, len(members), status, _describe(members))
        )
    return found


def count_reasons(records: Sequence[FrameRecord]) -> list[tuple[str, int]]:
    """The reasons of frames and how many have each, the commonest first; figures in a reason make no difference."""
    kinds = [_FIGURES.sub("", record.reason) for record in records]
    worded = {kind: record.reason for kind, record in zip(reversed(kinds), reversed(records), strict=True)}
    return [(worded[kind], count) for kind, count in Counter(kinds).most_common()]


def _describe(records: Sequence[FrameRecord]) -> str:
    reasons = count_reasons(records)
    if len(reasons) == 1:
        return reasons[0][0]
    return "; ".join(
        f"{reason or 'no reason given'}, {count} {'frame' if count == 1 else 'frames'}"
        for reason, count in reasons
    )
