"""What a run has done so far: how far each phase is, and what came of every frame that it took."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame


@dataclass(frozen=True)
class RunProgress:
    """Progress of a run."""

    last: int = -1  # index of the last frame that has its causal estimate; -1 before the first
    lines: int = 0  # bytes of frames.jsonl up to there
    refining: bool = False  # whether everything was solved once more
    last_refined: int = -1  # index of the last frame that was refined; -1 before the first
    refined_lines: int = 0  # bytes of the refined estimates up to there
    seconds: float = 0.0  # wall time of the run up to there, pauses left out
    refinement_seconds: float = 0.0  # the same of the final refinement

    def __post_init__(self) -> None:
        for one in fields(self):
            value, kind = getattr(self, one.name), type(one.default)
            if isinstance(value, bool) != (kind is bool) or not isinstance(value, int | kind):
                raise TypeError(f"{one.name} is {value!r:.40}")


@dataclass(frozen=True)
class JournalEntry:
    """The journal's record of a tracked frame, with what ``frames.jsonl`` does not hold."""

    index: int  # the frame's index in the source
    picture: int  # checksum of its image, see `checksum`
    score: float = 1.0  # score of its initial mask; reason: of the same
    reason: str = ""
    corrected: bool = False  # whether the estimate was fed back to the mask tracker
    failure: str = ""  # which plug-in failed at it, and why; empty if none did
    carried: bool = False  # whether the mask tracker was not asked


@dataclass(frozen=True)
class SavedState:
    """A run that was stopped."""

    progress: RunProgress  # its progress
    session: dict[str, Any]  # the session's state, see `tracking3d.pipeline.session.Session.state_dict`
    taken: dict[int, JournalEntry] = field(default_factory=dict)  # the frames that were taken, by index
    skipped: tuple[SkippedFrame, ...] = ()  # those that were not


def checksum(image: NDArray[np.uint8]) -> int:
    """The CRC-32 of an image."""
    return zlib.crc32(np.ascontiguousarray(image).reshape(-1).data)


def journal_line(frame: JournalEntry | SkippedFrame) -> bytes:
    """One frame as a line of the journal."""
    fields = asdict(frame)
    if isinstance(frame, SkippedFrame):
        fields["skipped"] = True
    return json.dumps(fields).encode("ascii") + b"\n"


def read_journal(text: bytes) -> tuple[dict[int, JournalEntry], tuple[SkippedFrame, ...]]:
    """The frames of a journal.

    Raises:
        ValueError: If a line is damaged.
    """
    taken, skipped = dict[int, JournalEntry](), list[SkippedFrame]()
    for line in text.splitlines():
        fields = json.loads(line)
        try:
            if fields.pop("skipped", False):
                skipped.append(SkippedFrame(**fields))
            else:
                frame = JournalEntry(**fields)
                taken[frame.index] = replace(frame, score=float(frame.score))
        except (TypeError, AttributeError) as error:
            raise ValueError(f"not a frame of the journal: {error}") from error
    return taken, tuple(skipped)


def check_picture(kept: SavedState, frame: Frame | SkippedFrame) -> None:
    """Make sure that a frame is the one that was estimated before the run was stopped.

    Raises:
        InputError: If it is not.
    """
    taken = kept.taken.get(frame.index)
    if isinstance(frame, SkippedFrame):
        raise InputError(
            f"Frame {frame.index} was read before the run was stopped, but cannot be now ({frame.reason})."
        )
    if taken is not None and taken.picture != checksum(frame.image):
        raise InputError(
            f"{frame.name or f'frame {frame.index}'} shows another image than when it was estimated; a run is "
            "resumed with the same source only."
        )
