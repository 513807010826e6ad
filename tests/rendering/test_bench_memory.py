"""Memory is measured in a process of its own, and only what the iterations need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import torch

from tracking3d.runtime import memory
from tracking3d.runtime.memory import resident_memory
from tracking3d_bench.speed.memory import peak_memory
from tracking3d_bench.speed.scene import RenderWorkload

CPU = torch.device("cpu")
needs_proc = pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="this system has no /proc/self/clear_refs"
)


PEAKS = """
from tracking3d.runtime.memory import resident_memory
from tracking3d_bench.speed.memory import forget_peak
forget_peak()
now, _ = resident_memory()
block = b"x" * int(64e6)
print(resident_memory()[1] - now)
del block
forget_peak()
print(resident_memory()[1] - now)
"""


@needs_proc
def test_the_peak_is_that_since_it_was_forgotten():
    """In a process in which nothing else is given back meanwhile."""
    told = subprocess.run([sys.executable, "-c", PEAKS], capture_output=True, text=True, check=True).stdout
    with_block, without = map(float, told.split())
    assert 60 < with_block < 80
    assert without < 20


def test_the_peak_is_never_below_the_present_size():
    now, peak = resident_memory()
    assert 0 < now <= peak


@pytest.mark.parametrize(("system", "unit"), [("linux", 1024), ("darwin", 1)])
def test_without_proc_the_operating_system_is_asked_in_its_unit(monkeypatch, system, unit):
    resource = pytest.importorskip("resource", reason="this system has no module resource")
    most = 10**12 // unit  # above what this process holds
    monkeypatch.setattr(memory, "_STATUS", Path("no such file"))
    monkeypatch.setattr(resource, "getrusage", lambda who: type("usage", (), {"ru_maxrss": most}))
    monkeypatch.setattr(sys, "platform", system)
    now, peak = resident_memory()
    assert 0 < now < peak == pytest.approx(1e6)


def test_windows_knows_the_peak_itself(monkeypatch):
    usage = type("usage", (), {"rss": 3_000_000, "peak_wset": 5_000_000})
    monkeypatch.setattr(psutil.Process, "memory_info", lambda self: usage)
    monkeypatch.setattr(sys, "platform", "win32")
    assert resident_memory() == pytest.approx((3.0, 5.0))


@pytest.mark.slow
@needs_proc
def test_a_backend_needs_at_least_the_gradient_of_the_texture():
    problem = RenderWorkload(size=32, frames=1, channels=32, texture=256)
    gradient = 4e-6 * problem.channels * problem.texture**2  # 8.4 MB
    assert gradient <= peak_memory("numba", problem, CPU) < 10 * gradient
