"""What a worker is asked to do where it matters that it leaves nothing behind."""

from __future__ import annotations

import os
from typing import Any


def hold(tell: Any) -> int:
    """Holds memory and files, and lets nothing go."""
    kept = bytearray(16_000_000)
    files = [os.open(os.devnull, os.O_RDONLY) for _ in range(20)]
    tell(len(files))
    return len(kept)
