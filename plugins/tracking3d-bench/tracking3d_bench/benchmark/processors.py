"""The same computation as on other processors: the kernels that a process is set to use, and whether it can.

OpenBLAS (NumPy, SciPy) and ATen (torch) choose their kernels by the processor, and environment variables make them
choose those of another one: https://github.com/OpenMathLib/OpenBLAS#setting-the-processor-architecture and
https://docs.pytorch.org/docs/stable/notes/multiprocessing.html. Kernels differ in the order of their sums, hence in
their rounding.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass

OPENBLAS, ATEN = "OPENBLAS_CORETYPE", "ATEN_CPU_CAPABILITY"

KERNELS: dict[str, dict[str, str]] = {
    **{f"OpenBLAS {core}": {OPENBLAS: core} for core in ("Haswell", "SkylakeX", "Zen", "Nehalem")},
    **{f"ATen {level}": {ATEN: level} for level in ("default", "avx2", "avx512")},
}
"""Environment variables by what the kernels are called."""

_PROBE = """
import numpy, torch
a = numpy.random.default_rng(0).normal(size=(96, 96))
numpy.linalg.eigh(a @ a.T)
numpy.linalg.svd(a.astype(numpy.float32))
image, where = torch.rand(1, 3, 64, 64), 2 * torch.rand(1, 32, 32, 2) - 1
torch.nn.functional.grid_sample(image, where, align_corners=False)
(torch.rand(4096).exp().log1p().sum() + torch.randn(64, 64).mm(torch.randn(64, 64)).sum()).item()
print(torch.backends.cpu.get_cpu_capability())
"""
_CORE = re.compile(r"^Core: *(\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Kernels:
    """What a process computes with."""

    openblas: str  # the processor whose kernels NumPy's OpenBLAS takes; empty if NumPy has another library
    aten: str  # the instructions whose kernels torch takes


def detect_kernels(environment: Mapping[str, str]) -> Kernels | None:
    """What a process with these environment variables computes with; None if this processor cannot run it."""
    found = subprocess.run(
        [sys.executable, "-c", _PROBE],
        env={**os.environ, "OPENBLAS_VERBOSE": "2", **environment},
        capture_output=True,
        text=True,
    )
    if found.returncode:
        return None
    cores = _CORE.findall(found.stderr + found.stdout)
    return Kernels(cores[0] if cores else "", found.stdout.strip().splitlines()[-1])
