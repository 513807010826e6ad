"""Programs of ``examples/`` as modules."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def example(name: str) -> ModuleType:
    """The module of ``examples/NAME.py``; nothing of it runs but its definitions."""
    title = f"example_{name.replace('/', '_')}"
    if title not in sys.modules:
        specification = importlib.util.spec_from_file_location(title, EXAMPLES / f"{name}.py")
        module = importlib.util.module_from_spec(specification)
        sys.modules[title] = module  # dataclasses and pydantic look their module up
        specification.loader.exec_module(module)
    return sys.modules[title]
