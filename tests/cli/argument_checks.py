"""Runs the command lines that standard input lists as JSON, and prints how each ends and what it imports.

A process of its own, in which none of `SLOW` can be imported: whoever tries is on record, and goes no further.
"""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib.machinery import ModuleSpec

SLOW = (
    "torch",
    "torchvision",
    "kornia",
    "numba",
    "onnxruntime",
    "pyarrow",
    "ray",
    "viser",
    "rerun",
    "pxr",
    "scipy.stats",
)
"""What takes longer to import than the answer to a mistake may take."""


class SlowImportError(BaseException):
    """Raised where one of `SLOW` is imported."""


class Refusal:
    """Finds slow modules, but does not load them."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        """Called for every module that is not imported yet, and to see whether it is installed."""
        return ModuleSpec(name, self) if name in SLOW else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> None:
        """Called when it is imported."""
        self.asked.append(spec.name)
        raise SlowImportError(spec.name)

    def exec_module(self, module: object) -> None:
        """Never called, but every loader has it."""


def main() -> None:
    """Run them all."""
    refusal = Refusal()
    sys.meta_path.insert(0, refusal)
    from tracking3d.cli import app

    ends = []
    for arguments in json.load(sys.stdin):
        refusal.asked.clear()
        printed = io.StringIO()
        code: object = "it went on"
        with redirect_stderr(printed), redirect_stdout(io.StringIO()):
            try:
                app(arguments)
            except SystemExit as error:
                code = error.code
            except SlowImportError:
                pass
        ends.append({"code": code, "said": printed.getvalue(), "imported": list(refusal.asked)})
    print(json.dumps(ends))


if __name__ == "__main__":
    main()
