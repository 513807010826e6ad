"""How much memory the iterations of a backend need.

On the CPU a process of its own imports everything, compiles the kernels on a tiny scene, builds the scene that is
asked for, and notes its resident set size. Then it runs a few iterations. The result is the highest resident set size
during these, less the noted one: what forward and backward passes and the gradients take, without libraries and data.
The allocator of glibc is set to give everything back that is large; what it would keep depends on what ran before.

On a GPU it is the same difference in what torch's allocator has handed out.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import torch

from tracking3d.runtime.memory import resident_memory
from tracking3d_bench.speed.scene import RenderScene, RenderWorkload
from tracking3d_bench.speed.timing import backends, set_benchmark_threads

ITERATIONS = 3
_TINY = RenderWorkload(size=16, frames=1, channels=1, texture=8, frequency=2)
_GIVE_BACK = 128 * 1024  # bytes; blocks of at least this size go back to the system at once


def forget_peak() -> None:
    """Reset the highest resident set size to the present one, if the system supports it (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory(name: str, problem: RenderWorkload, device: torch.device, threads: int = 1) -> float:
    """Megabytes (10^6 bytes) that a backend needs to solve a problem."""
    if device.type == "cuda":
        return _on_gpu(name, problem, device)
    asked = json.dumps({"name": name, "problem": asdict(problem), "threads": threads})
    command = [sys.executable, "-m", "tracking3d_bench.speed.memory", asked]
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": str(_GIVE_BACK)}
    answer = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    return float(answer)


def _in_this_process(name: str, problem: RenderWorkload, threads: int) -> float:
    device = torch.device("cpu")
    set_benchmark_threads(name, device, threads)
    backend = backends(device)[name]
    RenderScene.make(_TINY, device).loss(backend).backward()
    scene = RenderScene.make(problem, device)
    forget_peak()
    before, _ = resident_memory()
    for _ in range(ITERATIONS):
        scene.forget_gradients()
        scene.loss(backend).backward()
    _, peak = resident_memory()
    return max(peak - before, 0.0)


def _on_gpu(name: str, problem: RenderWorkload, device: torch.device) -> float:
    backend, scene = backends(device)[name], RenderScene.make(problem, device)
    before = torch.cuda.memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    for _ in range(ITERATIONS):
        scene.forget_gradients()
        scene.loss(backend).backward()
    return 1e-6 * (torch.cuda.max_memory_allocated(device) - before)


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    print(json.dumps(_in_this_process(asked["name"], RenderWorkload(**asked["problem"]), asked["threads"])))
