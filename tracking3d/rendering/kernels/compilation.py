"""Compiling kernels once and keeping them on disk.

Numba's cache replaces files atomically, and every kernel has one signature. Of several processes that need a kernel
at once, one compiles it and the others wait for its file. If no folder can be written, each compiles for itself.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock
from numba.core import event, types
from numpy.typing import NDArray
from torch import Tensor

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of every kernel: several may run at once, and dividing by zero gives infinity as it does in torch."""
REORDER = {"reassoc", "contract", "arcp", "nsz"}
"""Freedoms of sums and products that let them use vector instructions; NaN and infinity stay what they are."""

_log = logging.getLogger("tracking3d.rendering")
_compiling = threading.RLock()
_announced = threading.Event()


class Kernel:
    """A function that is compiled for one signature when it is called for the first time.

    Args:
        function: What to compile.
        signature: Numba types of its arguments, such as ``void(float32[::1], int64)``, in words or as Numba's own.
        fastmath: Freedoms of floating-point arithmetic; none by default.
    """

    def __init__(
        self, function: Callable[..., Any], signature: Any, fastmath: set[str] | None = None
    ) -> None:
        self._function, self._signature = function, signature
        self._options = {**OPTIONS, "fastmath": fastmath or False}
        self._compiled: Callable[..., Any] | None = None
        functools.update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        """Run it."""
        return (self._compiled or self.compile())(*arguments)

    def compile(self) -> Callable[..., Any]:
        """Compile it now, unless it is compiled."""
        if self._compiled is None:
            with _compiling:
                self._compiled = self._compiled or self._compile()
        return self._compiled

    def load(self) -> bool:
        """Load it now if it is kept on disk, and say whether it is there; else it is compiled when it is called."""
        if self._compiled is None and self.is_kept:
            self.compile()
        return self._compiled is not None

    @property
    def folder(self) -> Path | None:
        """Where it is kept; None if no folder can be written."""
        try:
            return Path(numba.njit(cache=True, **self._options)(self._function).stats.cache_path)
        except (RuntimeError, OSError):
            return None

    @property
    def is_kept(self) -> bool:
        """Whether it is kept on disk."""
        folder = self.folder
        return folder is not None and _is_kept(folder, self._function)

    def _compile(self) -> Callable[..., Any]:
        dispatcher = self._with_cache()
        if dispatcher is None:
            dispatcher = numba.njit(**self._options)(self._function)
            with event.install_listener("numba:compile", _Announcer(None)):
                dispatcher.compile(self._signature)
        dispatcher.disable_compile()
        compiled: Callable[..., Any] = dispatcher
        return compiled

    def _with_cache(self) -> Any:
        """Load or compile and keep; None if no folder can be written, or the kernel is at fault."""
        try:
            dispatcher = numba.njit(cache=True, **self._options)(self._function)
        except RuntimeError:
            return None
        folder = Path(dispatcher.stats.cache_path)
        for _ in range(2):
            try:
                with (
                    _alone(folder, self._function),
                    event.install_listener("numba:compile", _Announcer(folder)),
                ):
                    dispatcher.compile(self._signature)
                return dispatcher
            except Exception:  # what a damaged file raises can be anything
                if dispatcher.signatures:
                    return dispatcher  # it is compiled, but cannot be kept
                _forget(folder, self._function.__name__)
        return None


def kernel(signature: Any, fastmath: set[str] | None = None) -> Callable[[Callable[..., Any]], Kernel]:
    """Decorator that makes a `Kernel`."""
    return lambda function: Kernel(function, signature, fastmath)


def record(fields: type[tuple[Any, ...]], *field_types: Any) -> Any:
    """Numba's type of arguments that come together in a named tuple, for signatures.

    Args:
        fields: The named tuple.
        *field_types: Numba types of its fields, in their order.
    """
    return types.BaseTuple.from_types(field_types, fields)


def array(tensor: Tensor) -> NDArray[Any]:
    """The tensor's memory, or a contiguous copy of it."""
    result: NDArray[Any] = tensor.detach().contiguous().numpy()
    return result


def check_corners(faces: Tensor, screen: Tensor) -> None:
    """Make sure that faces have vertices: kernels do not look where they read.

    Raises:
        IndexError: If they have not.
    """
    count = screen.shape[1]
    if faces.numel() and not (0 <= int(faces.min()) and int(faces.max()) < count):
        raise IndexError(
            f"faces name vertices {int(faces.min())} to {int(faces.max())}, but there are {count} vertices"
        )


def _is_kept(folder: Path, function: Callable[..., Any]) -> bool:
    """Whether a compiled kernel is there that is not older than its source."""
    try:
        _drop_stale(folder, function)
    except OSError:
        return False
    return any(folder.glob(f"*.{function.__name__}-*.nbi"))


@contextlib.contextmanager
def _alone(folder: Path, function: Callable[..., Any]) -> Iterator[None]:
    """No other process compiles the kernel meanwhile; where files cannot be locked, another may do the same work."""
    if _is_kept(folder, function):
        yield
        return
    lock = FileLock(folder / f"{function.__module__}.{function.__name__}.lock")
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError, NotImplementedError):
            held.enter_context(lock)
        yield


def _drop_stale(folder: Path, function: Callable[..., Any]) -> None:
    """Forget a compiled kernel that is older than what it may be made of: Numba looks at its own file only."""
    package = Path(__file__).parents[2]
    shared = package / "geometry", package / "points/bundle_adjustment/kernels"
    rooms = {Path(__file__).parent, Path(function.__code__.co_filename).parent, *shared}
    newest = max(source.stat().st_mtime for room in rooms for source in room.glob("*.py"))
    if any(index.stat().st_mtime < newest for index in folder.glob(f"*.{function.__name__}-*.nbi")):
        _forget(folder, function.__name__)


def _forget(folder: Path, name: str) -> None:
    """Remove what says where a compiled kernel is kept."""
    for index in folder.glob(f"*.{name}-*.nbi"):
        with contextlib.suppress(OSError):
            index.unlink()


class _Announcer(event.Listener):
    """Tells the user of the first compilation in this process."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def on_start(self, event: event.Event) -> None:
        kept = "the result is kept" if self._folder else "no folder can be written to keep the result in"
        if not _announced.is_set():
            _log.warning("Compiling kernels for this processor takes some seconds; %s.", kept)
        _announced.set()

    def on_end(self, event: event.Event) -> None:
        pass


# Sharing a kernel's work among threads.
#
# Their number is a setting of the process, as torch's is, and independent of it: threads of torch that wait for
# work keep their cores busy, so that both together are slower than either. What a thread other than the main one sets
# holds for itself alone, so that two may track without knowing of each other.

_threads = 1
_of_thread = threading.local()


def set_num_threads(threads: int) -> None:
    """Let kernels use this many threads; the default is one.

    Raises:
        ValueError: If it is less than one.
    """
    global _threads
    if threads < 1:
        raise ValueError(f"the number of threads is {threads}; give one or more")
    if threading.current_thread() is threading.main_thread():
        _threads = threads
    else:
        _of_thread.threads = threads


def get_num_threads() -> int:
    """How many threads kernels may use."""
    own: int = getattr(_of_thread, "threads", _threads)
    return own


def share(kernel: Kernel, count: int, least: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments, first, last)`` on ranges that make up ``range(count)``.

    Args:
        kernel: Releases the GIL; calls for different ranges write to different places.
        count: How many items there are.
        least: Fewest items for which waking another thread pays.
        *arguments: Come before the range.
    """
    threads = min(get_num_threads(), count // least)
    if threads <= 1:
        kernel(*arguments, 0, count)
        return
    bounds = [count * part // threads for part in range(threads + 1)]
    others = [
        _pool(threads - 1).submit(kernel, *arguments, first, last)
        for first, last in itertools.pairwise(bounds[1:])
    ]
    kernel(*arguments, bounds[0], bounds[1])
    for other in others:
        other.result()


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "tracking3d-rendering")


# The threads of a pool do not survive a fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
