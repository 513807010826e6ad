"""Untrusted pickles: numpy arrays and plain values are read, anything else is refused before it is built."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path
from typing import Any

from tracking3d.errors import InputError

_PLAIN = frozenset(("list", "dict", "str", "int", "float", "bool", "tuple", "bytes"))
_NUMPY_CORE = ("numpy._core", "numpy.core")  # its name since numpy 2, and before
_ADMITTED = (
    {("builtins", name) for name in _PLAIN}
    | {("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")}
    | {(f"{core}.multiarray", name) for core in _NUMPY_CORE for name in ("_reconstruct", "scalar")}
    | {(f"{core}.numeric", "_frombuffer") for core in _NUMPY_CORE}
)
"""What numpy's arrays and scalars are pickled by; ``_codecs.encode`` is how old protocols write bytes."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(
                f"it holds {module}.{name}, but only numpy arrays and plain values are read"
            )
        return super().find_class(module, name)


def read_pickle(file: Path) -> Any:
    """Read a pickle of numpy arrays, numpy scalars, list, dict, str, int, float, bool, tuple and bytes.

    Raises:
        InputError: If the file is missing, damaged or holds anything else.
    """
    try:
        # Old names of numpy's modules still lead there, with a warning.
        with file.open("rb") as stream, warnings.catch_warnings(action="ignore"):
            return _Unpickler(stream).load()
    except FileNotFoundError as error:
        raise InputError(f"There is no file {file}; check the path.") from error
    except Exception as error:  # a damaged pickle can call what is admitted with anything
        reason = str(error) or type(error).__name__
        raise InputError(f"{file} cannot be read as a pickle: {reason}; use an .npz file.") from error
