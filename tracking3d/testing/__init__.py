"""Conformance checks for plug-ins, run in a one-line test.

>>> from tracking3d.testing import check_tracker
>>> def test_it_conforms() -> None:
...     check_tracker(MyTracker)  # doctest: +SKIP

A check that fails raises `AssertionError` with a sentence that says what was expected.
"""

from typing import TYPE_CHECKING

from tracking3d.runtime.deferred_import import import_on_use

if TYPE_CHECKING:
    from tracking3d.testing.encoders import check_encoder
    from tracking3d.testing.trackers import check_tracker

__all__ = ["check_encoder", "check_tracker"]

# Who makes a synthetic clip need not wait for torch.
__getattr__ = import_on_use(
    __name__,
    {"check_encoder": "tracking3d.testing.encoders", "check_tracker": "tracking3d.testing.trackers"},
)
