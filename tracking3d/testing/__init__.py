"""Conformance checks for plug-ins, run in a one-line test.

>>> from tracking3d.testing import check_tracker
>>> def test_it_conforms() -> None:
...     check_tracker(MyTracker)  # doctest: +SKIP

A check that fails raises `AssertionError` with a sentence that says what was expected.
"""

from tracking3d.testing.encoders import check_encoder
from tracking3d.testing.trackers import check_tracker

__all__ = ["check_encoder", "check_tracker"]
