"""Import of scripts that import each other by plain names, as Python does in the folder of a script."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def scripts_of(folder: Path) -> Iterator[None]:
    """Within it, plain names mean the scripts of a folder, even where a test has imported another of the same name."""
    names = {file.stem for file in folder.glob("*.py")}
    aside = {name: sys.modules.pop(name) for name in names & set(sys.modules)}
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for name in names & set(sys.modules):
            del sys.modules[name]
        sys.modules.update(aside)
