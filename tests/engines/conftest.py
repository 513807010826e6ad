"""Engines by name."""

from __future__ import annotations

import pytest

from tracking3d.engines.choosing import InThisProcess
from tracking3d.engines.processes import ProcessEngine


@pytest.fixture(params=["processes", "in this process"])
def engine(request):
    """Two workers where an engine has workers."""
    return ProcessEngine(2) if request.param == "processes" else InThisProcess()
