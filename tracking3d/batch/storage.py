"""Local and remote files: a path of this machine, or a URL supported by fsspec, such as ``s3://bucket/folder``."""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fsspec

from tracking3d.errors import InputError, OutputError
from tracking3d.results.files import write_atomic, writing

_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs"}
_FILE = "file://"


def local(place: str) -> Path | None:
    """The local path of a place; None if it is on other storage."""
    if place.startswith(_FILE):
        return Path(place.removeprefix(_FILE))
    if "://" in place:
        return None
    try:
        return Path(place).expanduser()
    except RuntimeError:  # there is no such user: a folder may begin with ~ too
        return Path(place)


def absolute(place: str, folder: str = ".") -> str:
    """The same place whatever the folder that a process is in; what is relative is so to ``folder``."""
    if "://" in place and not place.startswith(_FILE):
        return place
    path = local(place)
    assert path is not None
    if path.is_absolute():
        return str(path)
    return join_path(absolute(folder), place) if "://" in folder else str(Path(folder).absolute() / path)


def join_path(folder: str, *names: str) -> str:
    """A place within a folder."""
    if "://" in folder:
        return posixpath.join(folder, *names)
    return str(Path(folder, *names))


def parent(place: str) -> str:
    """The folder that a place is in."""
    return place.rstrip("/").rpartition("/")[0] if "://" in place else str(Path(place).parent)


def base(place: str) -> str:
    """The last part of a place."""
    return place.rstrip("/").rpartition("/")[2] if "://" in place else Path(place).name


def read(place: str) -> bytes | None:
    """What a file holds; None if there is none.

    Raises:
        InputError: If it cannot be read.
    """
    if path := local(place):
        try:
            return path.read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    files, inner = _open(place)
    with _reading(place):
        try:
            content: bytes = files.cat_file(inner)
            return content
        except FileNotFoundError:
            return None


def read_many(places: Sequence[str]) -> dict[str, bytes]:
    """Read the files that exist; on other storage they are read together.

    Raises:
        InputError: If one cannot be read.
    """
    if not places or local(places[0]) is not None:
        return {place: content for place in places if (content := read(place)) is not None}
    files, _ = _open(places[0])
    inner = {files._strip_protocol(place): place for place in places}
    with _reading(parent(places[0])):
        found = files.cat(list(inner), on_error="omit")
    return {inner[path]: content for path, content in found.items()}


def write(place: str, content: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        OutputError: If it cannot be written.
    """
    if path := local(place):
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, content)
        return
    files, inner = _open(place)
    with _writing(place):
        files.makedirs(parent(inner), exist_ok=True)
        files.pipe_file(inner, content)


def names_in(folder: str, *, everything: bool = False) -> dict[str, int]:
    """Names of the files in a folder and its subfolders, with their path, and the bytes of each.

    Args:
        folder: The folder.
        everything: Go into folders too; else they are names as files are.

    Raises:
        InputError: If there is no such folder.
    """
    files, inner = _open(folder)
    with _reading(folder):
        if not files.isdir(inner):
            raise InputError(f"{folder} is not a folder.")
        listed = files.find(inner, detail=True).values() if everything else files.ls(inner, detail=True)
        start = len(inner.rstrip("/")) + 1
        return {one["name"].rstrip("/")[start:]: int(one.get("size") or 0) for one in listed}


def matches(pattern: str) -> list[str]:
    """The places that a pattern with ``*`` or ``**`` names, in order.

    Raises:
        InputError: If it cannot be looked up.
    """
    files, inner = _open(pattern)
    with _reading(pattern):
        found = files.glob(inner)
        return sorted(_full(files, pattern, one) for one in found)


def is_folder(place: str) -> bool:
    """Whether it is a folder that exists."""
    files, inner = _open(place)
    with _reading(place):
        return bool(files.isdir(inner))


def copy_to_local(place: str, folder: Path) -> Path:
    """A file or folder from elsewhere, copied into ``folder``; a path of this machine as it is.

    Raises:
        InputError: If it cannot be read.
    """
    if path := local(place):
        return path
    files, inner = _open(place)
    target = folder / base(place)
    folder.mkdir(parents=True, exist_ok=True)
    with _reading(place):
        if not files.exists(inner):
            raise InputError(f"{place} does not exist.")
        if files.isdir(inner):
            for name in names_in(place, everything=True):
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                files.get_file(f"{inner.rstrip('/')}/{name}", str(target / name))
        else:
            files.get_file(inner, str(target))
    return target


def send(folder: Path, place: str, last: str) -> None:
    """Copy a folder to elsewhere; the file ``last`` in it, which says that all is there, comes at the end.

    Raises:
        OutputError: If it cannot be written.
    """
    files, inner = _open(place)
    inside = sorted(path for path in folder.rglob("*") if path.is_file())
    with _writing(place):
        for path in sorted(inside, key=lambda path: path == folder / last):
            target = posixpath.join(inner, path.relative_to(folder).as_posix())
            files.makedirs(parent(target), exist_ok=True)
            files.put_file(str(path), target)


def remove(place: str) -> None:
    """Remove a folder, if it is there.

    Raises:
        OutputError: If it cannot be removed.
    """
    files, inner = _open(place)
    with _writing(place):
        if files.exists(inner):
            files.rm(inner, recursive=True)


def _open(place: str) -> tuple[Any, str]:
    """The file system of a place, and what it calls the place."""
    try:
        files, inner = fsspec.core.url_to_fs(str(local(place) or place))
    except ImportError as error:
        kind = place.partition("://")[0]
        what = f"pip install 'tracking3d[{_EXTRAS[kind]}]'" if kind in _EXTRAS else f"the error is: {error}"
        raise InputError(
            f"Paths that begin with {kind}:// need a package that is not installed: {what}."
        ) from error
    except ValueError as error:
        raise InputError(f"{place} cannot be opened ({error}).") from error
    files.invalidate_cache()
    return files, inner


def _full(files: Any, pattern: str, inner: str) -> str:
    return inner if local(pattern) is not None else str(files.unstrip_protocol(inner))


@contextmanager
def _reading(place: str) -> Iterator[None]:
    try:
        yield
    except (InputError, FileNotFoundError):
        raise
    except Exception as error:  # every kind of storage has errors of its own
        raise InputError(f"{place} cannot be read: {_said(error)}.") from error


@contextmanager
def _writing(place: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise OutputError(f"{place} cannot be written: {_said(error)}.") from error


def _said(error: Exception) -> str:
    return " ".join(str(getattr(error, "strerror", None) or error).split()).rstrip(".")
