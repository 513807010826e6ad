"""This package as a tracker of the VOT toolkit; see ``examples/vot`` in the repository.

https://github.com/votchallenge/toolkit
"""

from __future__ import annotations

from tracking3d_bench.vot.tracker import VotTracker

__all__ = ["VotTracker"]
