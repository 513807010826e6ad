"""Untrusted pickles: numpy arrays and plain values are read, anything else is refused before it is built.

The standard library's ``pickletools`` splits a pickle into its instructions; they are followed here, and not by
``pickle``, which can be crashed by instructions alone: a tuple that is nested a million times and then the key of a
dict overflows the stack.
"""

from __future__ import annotations

import pickletools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tracking3d.errors import InputError
from tracking3d_bench.datasets.readers.pickled_arrays import ADMITTED, Name, Unfinished, call

# fmt: off
_VALUES = frozenset((
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES",
    "BINBYTES8", "BYTEARRAY8",
))
# fmt: on
"""Instructions whose argument is the value."""
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_MARK = object()


def read_pickle(file: Path) -> Any:
    """Read a pickle of numpy arrays, numpy scalars, list, dict, str, int, float, bool, tuple and bytes.

    Arrays are of numbers, bool or texts, and cannot be written to.

    Raises:
        InputError: If the file is missing, damaged or holds anything else.
    """
    try:
        with file.open("rb") as stream:
            return _Machine().run(pickletools.genops(stream))
    except FileNotFoundError as error:
        raise InputError(f"There is no file {file}; check the path.") from error
    except Exception as error:  # a damaged pickle can be wrong in any way
        reason = str(error) if isinstance(error, ValueError) else "it is damaged"
        raise InputError(f"{file} cannot be read as a pickle: {reason}; use an .npz file.") from error


class _Machine:
    """Follows the instructions of a pickle."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self, instructions: Iterator[tuple[pickletools.OpcodeInfo, Any, int | None]]) -> Any:
        """What the pickle holds.

        Raises:
            ValueError: If that is not admitted.
        """
        for code, argument, _ in instructions:
            name = code.name
            if name in _VALUES:
                self._stack.append(argument)
            elif name in _CONSTANTS:
                self._stack.append(_CONSTANTS[name])
            elif name in _TUPLES:
                self._stack.append(tuple(self._pop(_TUPLES[name])))
            elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
                self._memo[len(self._memo) if argument is None else argument] = self._top()
            elif name in ("GET", "BINGET", "LONG_BINGET"):
                self._stack.append(self._memo[argument])
            elif name not in ("PROTO", "FRAME", "STOP"):
                self._build(name, argument)
        (value,) = self._pop(1)
        return value

    def _build(self, instruction: str, argument: Any) -> None:
        """Instructions that put together what is on the stack."""
        match instruction:
            case "MARK":
                self._stack.append(_MARK)
            case "EMPTY_LIST":
                self._stack.append([])
            case "EMPTY_DICT":
                self._stack.append({})
            case "LIST":
                self._stack.append(self._pop_to_mark())
            case "TUPLE":
                self._stack.append(tuple(self._pop_to_mark()))
            case "DICT":
                self._stack.append(_mapping(self._pop_to_mark()))
            case "APPEND" | "APPENDS":
                items = self._pop(1) if instruction == "APPEND" else self._pop_to_mark()
                _expect(self._top(), list).extend(items)
            case "SETITEM" | "SETITEMS":
                items = self._pop(2) if instruction == "SETITEM" else self._pop_to_mark()
                _expect(self._top(), dict).update(_mapping(items))
            case "GLOBAL":
                self._stack.append(_named(*argument.split(" ", 1)))
            case "STACK_GLOBAL":
                self._stack.append(_named(*self._pop(2)))
            case "REDUCE":
                self._stack.append(call(*self._pop(2)))
            case "BUILD":
                (state,) = self._pop(1)
                _expect(self._top(), Unfinished).set_state(state)
            case _:
                raise ValueError(f"it holds {instruction}, but only numpy arrays and plain values are read")

    def _top(self) -> Any:
        if not self._stack or self._stack[-1] is _MARK:
            raise ValueError("it is damaged")
        return self._stack[-1]

    def _pop(self, count: int) -> list[Any]:
        taken = self._stack[len(self._stack) - count :] if count else []
        if len(taken) < count:
            raise ValueError("it is damaged")
        del self._stack[len(self._stack) - count :]
        return [_finished(one) for one in taken]

    def _pop_to_mark(self) -> list[Any]:
        for back in range(1, len(self._stack) + 1):
            if self._stack[-back] is _MARK:
                items = self._pop(back - 1)
                self._stack.pop()
                return items
        raise ValueError("it is damaged")


def _finished(value: Any) -> Any:
    if isinstance(value, Unfinished):
        value = value.value
        if value is None:
            raise ValueError("it holds an array without values")
    elif value is _MARK:
        raise ValueError("it is damaged")
    return value


def _named(module: Any, name: Any) -> Name:
    text = f"{module}.{name}"
    if text.startswith("__builtin__."):  # its name in Python 2, which old protocols keep
        text = text.replace("__builtin__", "builtins", 1)
    if text not in ADMITTED:
        raise ValueError(f"it holds {text}, but only numpy arrays and plain values are read")
    return Name(text)


def _mapping(items: list[Any]) -> dict[Any, Any]:
    """Keys and values in turn; a key is a plain value, since hashing others may take any depth."""
    keys, values = items[::2], items[1::2]
    if not all(isinstance(key, str | bytes | int | float | None) for key in keys):
        raise ValueError("it holds a dict with a key that is no plain value")
    return dict(zip(keys, values, strict=True))


def _expect(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise ValueError("it is damaged")
    return value
