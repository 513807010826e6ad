"""When a video was recorded, as its container says."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import av
from av.error import FFmpegError


def recording_time(path: Path) -> float | None:
    """Seconds from 1970 to the start of a video file; None if it is no file, or does not say."""
    if not path.is_file():
        return None
    try:
        with av.open(f"file:{path}", metadata_errors="ignore") as container:
            return seconds_since_1970(container.metadata["creation_time"])
    except (FFmpegError, OSError, KeyError, ValueError):
        return None


def seconds_since_1970(text: str) -> float:
    """An ISO 8601 time, in UTC if it names no zone.

    Raises:
        ValueError: It is none.
    """
    time = datetime.fromisoformat(text.strip())
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
