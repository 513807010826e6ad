"""When Python looks for garbage in cycles: not while modules are imported, which make none."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collection_deferred() -> Iterator[None]:
    """Collect no garbage meanwhile, and never look again at the objects that are alive at the end.

    Importing torch and numba takes a fifth less time so, and each full collection after it has a few thousand
    objects to look at instead of some hundred thousand.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()
