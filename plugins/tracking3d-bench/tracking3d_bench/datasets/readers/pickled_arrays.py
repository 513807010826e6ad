"""What numpy's pickles name, done again on plain bytes: numpy's own functions trust the pickle with pointers.

`numpy.dtype.__setstate__` turns raw bytes into object pointers if the state says so, and `ndarray.__setstate__` frees
memory that another array may still use. Here an array is made of bytes that are as long as its shape needs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PLAIN = re.compile(r"b1|[iu][1248]|f(2|4|8|12|16)|[SU]\d{1,6}")
_BYTE_ORDERS = ("<", ">", "|", "=")
_NUMPY_CORE = ("numpy._core", "numpy.core")  # its name since numpy 2, and before


@dataclass(frozen=True)
class Name:
    """A name that a pickle uses and that stands for no value of its own.

    Attributes:
        text: The name with its module.
    """

    text: str


@dataclass(eq=False)
class Unfinished:
    """A type or an array whose state comes later in the pickle.

    Attributes:
        kind: ``dtype`` or ``ndarray``.
        value: What it is so far; None for an array without state.
    """

    kind: str
    value: Any = None

    def set_state(self, state: Any) -> None:
        """Complete it.

        Raises:
            ValueError: If the state is none of a plain type or array.
        """
        if self.kind == "dtype":
            version, order, *structure = _tuple(state)
            # Sub-array, names and fields; then size, alignment and flags, which the name already says.
            if version not in (3, 4) or order not in _BYTE_ORDERS or any(one for one in structure[:3]):
                raise ValueError("it holds a structured type")
            self.value = self.value if order == "|" else self.value.newbyteorder(order)
        else:
            version, shape, dtype, columns_first, data = _tuple(state)
            self.value = _array(data, dtype, shape, "F" if columns_first else "C")


def call(function: Any, arguments: Any) -> Any:
    """The result of what numpy's pickles call.

    Raises:
        ValueError: If it is called with anything else than numpy does.
    """
    given = _tuple(arguments)
    maker = _MAKERS.get(function.text) if isinstance(function, Name) else None
    if maker is None:
        raise ValueError("it calls what is no function")
    return maker(*given)


def _dtype(name: Any, align: Any = False, copy: Any = True) -> Unfinished:
    if not isinstance(name, str) or not _PLAIN.fullmatch(name):
        raise ValueError(f"it holds an array of type {str(name)[:20]}, but only numbers and texts are read")
    return Unfinished("dtype", np.dtype(name))


def _reconstruct(kind: Any, shape: Any, typecode: Any) -> Unfinished:
    if kind != Name("numpy.ndarray"):
        raise ValueError("it holds an array of a class of its own")
    return Unfinished("ndarray")


def _scalar(dtype: Any, data: Any) -> Any:
    return _array(data, dtype, (), "C")[()]


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> NDArray[Any]:
    if order != "K":
        return _array(data, dtype, shape, order)
    return _array(data, dtype, shape, "C").transpose(_tuple(axes))


def _encode(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise ValueError("it encodes bytes as numpy does not")
    return text.encode("latin-1")


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    """An array on ``data``, which must be exactly as long as the array."""
    if not isinstance(dtype, np.dtype) or not isinstance(data, bytes | bytearray) or order not in ("C", "F"):
        raise ValueError("it holds an array that is not made of bytes")
    sides = _tuple(shape)
    if len(sides) > 32 or not all(type(side) is int and side >= 0 for side in sides):
        raise ValueError("it holds an array whose shape is none")
    if math.prod(sides) * dtype.itemsize != len(data) or not dtype.itemsize:
        raise ValueError("it holds an array whose bytes do not fit its shape")
    return np.ndarray(sides, dtype, data, order=order)


def _tuple(value: Any) -> tuple[Any, ...]:
    if not isinstance(value, tuple):
        raise ValueError("it holds a list of arguments that is none")
    return value


_MAKERS: Mapping[str, Callable[..., Any]] = {
    "numpy.dtype": _dtype,
    "_codecs.encode": _encode,  # old protocols write bytes so
    "builtins.bytes": lambda: b"",
    **{f"{core}.multiarray._reconstruct": _reconstruct for core in _NUMPY_CORE},
    **{f"{core}.multiarray.scalar": _scalar for core in _NUMPY_CORE},
    **{f"{core}.numeric._frombuffer": _frombuffer for core in _NUMPY_CORE},
}
ADMITTED = frozenset(("numpy.ndarray", *_MAKERS))
"""Names that a pickle may use."""
