"""Trees of dataclasses, arrays and plain values as JSON text; large arrays lie in files of their own, each once.

A solver's state is a tree of frozen dataclasses. From one frame to the next most of it is the same object, not only
the same value: such a part is neither encoded nor written again. Nothing is pickled, and a class is only built if it
was named beforehand.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.runtime.array_files import ArrayFile

INLINE = 1024
"""Bytes from which on an array has a file of its own."""
MOST_COMPRESSED = 2**30
"""Bytes that the arrays of one tree may take beyond those of their files."""
SUFFIX = ".npz"
_KINDS = "biuf"
_NAME = re.compile(r"\d{8,}\.npz")


class NotSerializableError(TypeError):
    """A value cannot be saved in a tree."""


@dataclass(eq=False)
class _Part:
    """An object that is encoded already."""

    value: object  # the object, held so that its identity is not given to another one
    text: str  # its JSON
    file: str | None = None  # its file, if it has one
    parts: list[_Part] = field(default_factory=list)  # objects within it

    def within(self) -> Iterator[_Part]:
        """This node and all within it, each once, or twice if one node names it twice."""
        waiting, seen = [self], {id(self)}
        while waiting:
            part = waiting.pop()
            yield part
            new = [inner for inner in part.parts if id(inner) not in seen]
            seen.update(map(id, new))
            waiting.extend(new)


class TreeFolder:
    """Arrays of the trees that are written one after the other, in a folder.

    Args:
        folder: Existing folder of the array files.
        classes: Dataclasses and enumerations that a tree may hold.
        device: The device of the tensors when a tree is read.
    """

    def __init__(self, folder: Path, classes: tuple[type, ...], device: str = "cpu") -> None:
        self._folder, self._device = folder, device
        self._classes = {one.__name__: one for one in classes}
        self._known: dict[int, _Part] = {}
        self._by_text: dict[str, _Part] = {}
        numbers = [int(path.stem) for path in folder.glob(f"*{SUFFIX}") if path.stem.isdigit()]
        self._next = max(numbers, default=-1) + 1
        self._root = _Part(None, "null")
        self._spared: set[str] = set()  # files of earlier trees that are needed still
        self._left = MOST_COMPRESSED

    def text(self, tree: Any) -> str:
        """The tree as JSON text; arrays that are not in a file yet are written.

        Raises:
            NotSerializableError: If a value in it cannot be saved.
            OSError: If an array cannot be written.
        """
        self._root = _Part(None, "")
        self._root.text = self._encode(tree, self._root)
        return self._root.text

    def read(self, node: Any) -> Any:
        """The tree whose text, as read by the module `json`, is ``node``.

        Raises:
            ValueError: If it is not one, or an array is missing or damaged.
        """
        self._root, self._left = _Part(None, ""), MOST_COMPRESSED
        try:
            return self._decode(node, self._root)
        except (OSError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            raise ValueError(str(error) or type(error).__name__) from error
        finally:
            self._by_text.clear()

    @property
    def arrays(self) -> frozenset[str]:
        """Names of the files that the latest tree needs."""
        return frozenset(part.file for part in self._root.within() if part.file)

    def tidy(self, needed: Collection[str] = ()) -> None:
        """Remove the files that the latest tree does not name, except those ``needed`` otherwise.

        A file that was needed is removed as soon as it is not.
        """
        used = {id(part): part for part in self._root.within()}
        for part in self._known.values():
            if id(part) not in used and part.file:
                self._spared.add(part.file)
        gone = self._spared - set(needed)
        for name in gone:
            (self._folder / name).unlink(missing_ok=True)
        self._spared -= gone
        used.pop(id(self._root), None)
        self._known = {id(part.value): part for part in used.values()}

    def remove_orphans(self, needed: Collection[str] = ()) -> None:
        """Remove array files that neither the latest tree names nor are ``needed``, such as those that a kill left."""
        named = self.arrays
        self._spared = set(needed) - named
        for path in self._folder.glob(f"*{SUFFIX}"):
            if path.name not in named and path.name not in self._spared:
                path.unlink(missing_ok=True)

    def _encode(self, value: Any, within: _Part) -> str:
        if value is None or (isinstance(value, bool | int | str) and not isinstance(value, Enum)):
            return json.dumps(value)
        if isinstance(value, Enum):
            return json.dumps({"enum": self._name_of(type(value)), "value": value.value})
        if isinstance(value, float):
            return repr(float(value)) if math.isfinite(value) else json.dumps({"float": repr(float(value))})
        if isinstance(value, tuple | list):
            items = ", ".join(self._encode(item, within) for item in value)
            return f'{{"tuple": [{items}]}}' if isinstance(value, tuple) else f"[{items}]"
        if isinstance(value, Mapping):
            pairs = (
                f"[{self._encode(key, within)}, {self._encode(item, within)}]" for key, item in value.items()
            )
            return f'{{"dict": [{", ".join(pairs)}]}}'
        part = self._known.get(id(value))
        if part is None or part.value is not value:
            part = self._part(value)
            self._known[id(value)] = part
        within.parts.append(part)
        return part.text

    def _part(self, value: Any) -> _Part:
        part = _Part(value, "")
        if isinstance(value, np.ndarray | np.generic):
            part.text, part.file = self._encode_array(np.asarray(value))
        elif isinstance(value, Tensor):
            part.text, part.file = self._encode_tensor(value.detach())
        elif is_dataclass(value) and not isinstance(value, type):
            inner = ", ".join(
                f"{json.dumps(one.name)}: {self._encode(getattr(value, one.name), part)}"
                for one in fields(value)
            )
            part.text = f'{{"class": "{self._name_of(type(value))}", "fields": {{{inner}}}}}'
        else:
            raise NotSerializableError(f"a {type(value).__name__} cannot be saved")
        return part

    def _name_of(self, kind: type) -> str:
        if self._classes.get(kind.__name__) is not kind:
            raise NotSerializableError(f"a {kind.__name__} cannot be saved")
        return kind.__name__

    def _encode_tensor(self, tensor: Tensor) -> tuple[str, str | None]:
        if tensor.layout == torch.sparse_coo:
            tensor = tensor.coalesce()
            index, value = tensor.indices().cpu().numpy(), tensor.values().cpu().numpy()
            about = {"size": list(tensor.shape)}
            name = self._write(index=index, value=value)
            return json.dumps({"sparse": {"file": name}, **about}), name
        # The axes as they lie in memory, so that what is computed from it rounds as it did.
        axes = sorted(range(tensor.ndim), key=tensor.stride().__getitem__, reverse=True)
        text, file = self._encode_array(tensor.permute(axes).contiguous().cpu().numpy())
        return f'{{"tensor": {text}, "axes": {axes}}}', file

    def _encode_array(self, array: NDArray[Any]) -> tuple[str, str | None]:
        if array.dtype.kind not in _KINDS:
            raise NotSerializableError(f"an array of {array.dtype} cannot be saved")
        about: dict[str, Any] = {"array": array.dtype.str, "shape": list(array.shape)}
        if array.nbytes < INLINE:
            data = base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
            return json.dumps({**about, "data": data}), None
        if _only_zero_and_one(array):
            name = self._write(bits=np.packbits(array.astype(np.bool_)))
        else:
            name = self._write(array=np.ascontiguousarray(array))
        return json.dumps({**about, "file": name}), name

    def _write(self, **arrays: NDArray[Any]) -> str:
        name = f"{self._next:08d}{SUFFIX}"
        self._next += 1
        np.savez(self._folder / name, **arrays)  # type: ignore[arg-type]
        return name

    def _open(self, name: Any) -> ArrayFile:
        if not isinstance(name, str) or not _NAME.fullmatch(name) or (self._folder / name).is_symlink():
            raise ValueError(f"it names {name!r}, which is no file of this state")
        return ArrayFile(self._folder / name)

    def _read(self, arrays: ArrayFile, name: str) -> NDArray[Any]:
        self._reserve(arrays.header(name).nbytes, arrays.bytes)
        return arrays.read(name, arrays.header(name).nbytes)

    def _reserve(self, size: int, expected: int) -> None:
        """Count what an array takes beyond what is ``expected`` of its file; earlier versions compressed some."""
        self._left -= max(size - expected, 0)
        if self._left < 0:
            raise ValueError("its arrays take more memory than those of a state")

    def _decode(self, node: Any, within: _Part) -> Any:
        if isinstance(node, list):
            return [self._decode(item, within) for item in node]
        if not isinstance(node, dict):
            return node
        if "tuple" in node:
            return tuple(self._decode(item, within) for item in node["tuple"])
        if "dict" in node:
            return {self._decode(key, within): self._decode(item, within) for key, item in node["dict"]}
        if "float" in node:
            return float(node["float"])
        if "enum" in node:
            return self._classes[node["enum"]](node["value"])
        if "class" in node:
            part = _Part(None, json.dumps(node))
            inner = {name: self._decode(item, part) for name, item in node["fields"].items()}
            part.value = self._classes[node["class"]](**inner)
        else:
            part = self._array_part(node)
        self._known[id(part.value)] = part
        within.parts.append(part)
        return part.value

    def _array_part(self, node: dict[str, Any]) -> _Part:
        """The array or tensor of a node; the same object wherever the same file is named."""
        text = json.dumps(node)
        inner = node.get("tensor") or node.get("sparse") or node
        file = inner.get("file")
        if file and text in self._by_text:
            return self._by_text[text]
        part = self._by_text[text] = self._read_part(node, inner, text, file)
        return part

    def _read_part(self, node: dict[str, Any], inner: dict[str, Any], text: str, file: str | None) -> _Part:
        if "sparse" in node:
            with self._open(file) as arrays:
                index, value = (torch.from_numpy(self._read(arrays, name)) for name in ("index", "value"))
            sparse = torch.sparse_coo_tensor(index, value, node["size"], check_invariants=True)
            return _Part(sparse.coalesce().to(self._device), text, file)
        array = self._array(inner)
        if "tensor" not in node:
            return _Part(array, text, file)
        back = [node["axes"].index(axis) for axis in range(array.ndim)]
        return _Part(torch.from_numpy(array).to(self._device).permute(back), text, file)

    def _array(self, node: dict[str, Any]) -> NDArray[Any]:
        kind, shape = np.dtype(node["array"]), tuple(node["shape"])
        if kind.kind not in _KINDS:
            raise ValueError(f"it holds an array of {kind}")
        if "data" in node:
            return np.frombuffer(base64.b64decode(node["data"]), kind).reshape(shape).copy()
        with self._open(node["file"]) as arrays:
            if "bits" in arrays.names:
                bits, count = self._read(arrays, "bits"), math.prod(shape)
                if not 0 <= count <= 8 * bits.size:
                    raise ValueError(f"{node['file']} holds another array than was saved")
                self._reserve(count * kind.itemsize, 8 * arrays.bytes * kind.itemsize)
                return np.unpackbits(bits, count=count).astype(kind).reshape(shape)
            found = self._read(arrays, "array")
        if found.shape != shape or found.dtype != kind:
            raise ValueError(f"{node['file']} holds another array than was saved")
        return found


def _only_zero_and_one(array: NDArray[Any]) -> bool:
    """Whether a bit is enough for every value; a few of them already show that most arrays need more."""
    if array.dtype.kind == "b":
        return True
    few = array.reshape(-1)[:: max(array.size // 64, 1)]
    return all(bool(((part == 0) | (part == 1)).all()) for part in (few, array)) and not (
        array.dtype.kind == "f" and bool(np.signbit(array).any())
    )
