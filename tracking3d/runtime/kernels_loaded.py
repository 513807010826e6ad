"""Importing this loads all kernels that are kept on disk.

The process that others are forked from imports it, so that they need not load them each: half a second a process.
Nothing is compiled here, because it is not known yet what will be needed.
"""

from __future__ import annotations

import importlib
from contextlib import suppress

from tracking3d.runtime.kernels_ahead import find_kernels, kernel_modules

for _name in kernel_modules():
    with suppress(Exception):  # whoever needs it gets an error later
        for _kernel in find_kernels(importlib.import_module(_name)):
            _kernel.load()
