"""Atomic writing of files, with errors in one sentence; masks and probabilities as files, and a run folder's lock."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, OutputError
from tracking3d.frames import OCCLUDER, Prompt
from tracking3d.results import layout
from tracking3d.results.layout import OUT, partial_path
from tracking3d.trackers.prompts.corrections import Correction

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
_BLOCK = 4096  # bytes that file systems give out at once
_NOT_A_FOLDER = {errno.ENOTDIR, errno.EEXIST}


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the operating system's errors about ``path`` into one sentence.

    Raises:
        OutputError: On any `OSError` inside the block.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            what = f"The disk is full at {path}; free some space (finished frames are saved)."
        elif error.errno in _FORBIDDEN:
            what = f"{path} is not writable; choose another {OUT}."
        elif error.errno in _NOT_A_FOLDER:
            what = f"{path} is not a folder or lies inside a file; choose another {OUT}."
        else:
            what = f"{path} cannot be written: {error.strerror or error}; choose another {OUT}."
        raise OutputError(what) from error


def write_atomic(path: Path, data: bytes) -> None:
    """Write ``data`` under a temporary name and rename it into place.

    Raises:
        OutputError: If it cannot be written; ``path`` is then as it was.
    """
    write_together({path: data})


def write_together(files: Mapping[Path, bytes], when_whole: Callable[[], None] = lambda: None) -> None:
    """Write files that belong together under temporary names, and rename them when all are whole.

    Args:
        files: Contents by path.
        when_whole: Is called before they are renamed.

    Raises:
        OutputError: If one cannot be written; nothing has been renamed then.
    """
    try:
        for path, data in files.items():
            with writing(path):
                partial_path(path).write_bytes(data)
        when_whole()
        for path in files:
            with writing(path):
                partial_path(path).replace(path)
    except BaseException:
        for path in files:
            with suppress(OSError):
                partial_path(path).unlink(missing_ok=True)
        raise


def link_or_copy(source: Path, target: Path) -> None:
    """Hard-link a file that is never overwritten; copy it if that is not possible.

    Raises:
        OSError: If it cannot be written.
    """
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def write_reserved(path: Path, data: bytes, reserve: int) -> None:
    """Write text as `write_atomic` does, with ``reserve`` spaces or more after it.

    If the disk is full, it overwrites the old file, in whose reserve it has room: it can always be said how a run
    ended.

    Raises:
        OutputError: If it cannot be written, or has no room either; ``path`` is then as it was.
    """
    blocks = -(-(len(data) + reserve) // _BLOCK)
    try:
        write_atomic(path, data[:-1] + b" " * (blocks * _BLOCK - len(data)) + b"\n")
    except OutputError as error:
        full = isinstance(error.__cause__, OSError) and error.__cause__.errno in _FULL
        if not full or not path.is_file() or len(data) > (room := path.stat().st_size):
            raise
        with writing(path), path.open("r+b") as file:
            file.write(data[:-1] + b" " * (room - len(data)) + b"\n")


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write ``(H, W)`` grey or ``(H, W, 3)`` RGB uint8 as PNG, atomically."""
    write_atomic(path, image_file(image))


def image_file(image: NDArray[np.uint8]) -> bytes:
    """``(H, W)`` grey or ``(H, W, 3)`` RGB uint8 as PNG."""
    ordered = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    return cv2.imencode(".png", ordered)[1].tobytes()


def write_mask(path: Path, mask: NDArray[np.bool_], occluder: NDArray[np.bool_] | None = None) -> None:
    """Write ``(H, W)`` bool as a 0/255 PNG, atomically; `OCCLUDER` where an ``occluder`` ``(H, W)`` is beside it."""
    levels = np.where(mask, np.uint8(255), np.uint8(0))
    if occluder is not None:
        levels[occluder & ~mask] = OCCLUDER
    write_atomic(path, image_file(levels))


def mask_file(mask: NDArray[np.bool_]) -> bytes:
    """``(H, W)`` bool as a 0/255 PNG."""
    return image_file(mask.astype(np.uint8) * np.uint8(255))


def read_mask(path: Path) -> NDArray[np.bool_] | None:
    """Read a mask written by `write_mask`: ``(H, W)`` bool, or None if there is no such image."""
    kept = read_packed_mask(path)
    return None if kept is None else unpack(kept.mask, kept.shape)


@dataclass(frozen=True)
class PackedMask:
    """A mask image that was decoded, as bits."""

    shape: tuple[int, int]  # (H, W)
    mask: bytes  # the pixels from 128 on, see `unpack`
    occluder: bytes | None  # the pixels of `OCCLUDER`; None if there are none


def read_packed_mask(path: Path) -> PackedMask | None:
    """A mask image as bits; None if there is no such image.

    Those that were read are kept: several steps look at the same masks, and decoding a large image takes twenty times
    as long as unpacking it.
    """
    try:
        status = path.stat()
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode):
        return None
    return _read_version(path, status.st_ino, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4096)
def _read_version(path: Path, *version: int) -> PackedMask | None:
    levels = decode_grey(path.read_bytes())
    if levels is None:
        return None
    occluder = levels == OCCLUDER
    height, width = levels.shape
    return PackedMask((height, width), pack(levels >= 128), pack(occluder) if occluder.any() else None)


def pack(mask: NDArray[np.bool_]) -> bytes:
    """``(H, W)`` a mask as bits, see `unpack`."""
    return zlib.compress(np.packbits(mask).tobytes(), 1)


def unpack(packed: bytes, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """``(H, W)`` the mask of some bits in a `PackedMask`."""
    bits = np.frombuffer(zlib.decompress(packed), np.uint8)
    return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).view(np.bool_)


def decode_mask(data: bytes) -> NDArray[np.bool_] | None:
    """A mask from the bytes of such a file; None if they are no image, or too large a one."""
    image = decode_grey(data)
    return None if image is None else image >= 128


def decode_grey(data: bytes) -> NDArray[np.uint8] | None:
    """``(H, W)`` from the bytes of an image file; None if they are no image, or too large a one."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    except cv2.error:  # more pixels than OpenCV decodes
        return None


def first_problem(*steps: Callable[[], None]) -> Exception | None:
    """Take every step; give the first error any of them raised."""
    problem: Exception | None = None
    for step in steps:
        try:
            step()
        except Exception as error:
            problem = problem or error
    return problem


# What is seen of the object, ``visible_masks/``: the estimated masks without what is in front of them.
#
# They are written at the end of a run whose mask tracker says what is in front of the object.


def expect_visible_masks(folder: Path) -> None:
    """Make the folder of the visible masks, so that they are written at the end.

    Args:
        folder: The run folder.

    Raises:
        OutputError: If it cannot be made.
    """
    with writing(folder / layout.VISIBLE_MASKS):
        (folder / layout.VISIBLE_MASKS).mkdir(exist_ok=True)


def write_visible_masks(folder: Path) -> None:
    """Write what is seen of the object in every frame of a run, if it is known.

    Args:
        folder: The run folder, with the final masks.

    Raises:
        OutputError: If something cannot be written.
    """
    if not (folder / layout.VISIBLE_MASKS).is_dir():
        return
    for path in sorted((folder / layout.MASKS).glob("*.png")):
        mask, occluder = read_mask(path), read_occluder(folder, int(path.stem))
        if mask is not None:
            visible = mask if occluder is None else mask & ~occluder
            write_mask(layout.visible_mask_path(folder, int(path.stem)), visible)


def read_occluder(folder: Path, index: int) -> NDArray[np.bool_] | None:
    """What is in front of the object in frame ``index``, ``(H, W)``; None if nothing is known to be."""
    kept = read_packed_mask(layout.initial_mask_path(folder, index))
    return None if kept is None or kept.occluder is None else unpack(kept.occluder, kept.shape)


def write_probability(folder: Path, index: int, probability: NDArray[np.float32] | None) -> None:
    """Write it ``(H, W)`` beside the masks of a folder; None removes that of an earlier estimate.

    Raises:
        OutputError: If it cannot be written.
    """
    path = layout.probability_path(folder, index)
    with writing(path):
        path.parent.mkdir(exist_ok=True)
        if probability is None:
            path.unlink(missing_ok=True)
    if probability is not None:
        write_image(path, np.rint(255 * probability).clip(0, 255).astype(np.uint8))


def read_probability(folder: Path, index: int) -> NDArray[np.float32] | None:
    """It again ``(H, W)``, in steps of 1/255; None if there is none."""
    path = layout.probability_path(folder, index)
    if not path.is_file() or not path.stat().st_size:
        return None
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if image is None else image.astype(np.float32) / 255


def take_over_probability(aside: Path, folder: Path, index: int) -> None:
    """Replace the causal estimate's probability by the refined one's, in a run that has them.

    Raises:
        OSError: If it cannot be moved.
    """
    if not (folder / layout.PROBABILITIES).is_dir():
        return
    refined, place = layout.probability_path(aside, index), layout.probability_path(folder, index)
    if refined.is_file():
        refined.replace(place)
    else:
        place.unlink(missing_ok=True)


def keep_given_masks(
    folder: Path, first: int, prompt: Prompt | None, corrections: Iterable[Correction] = ()
) -> None:
    """Write the masks of the first frame and of corrections, if they were given as masks.

    Args:
        folder: The run folder.
        first: Index of the frame that the prompt is of.
        prompt: The object in it.
        corrections: What it is in later frames.

    Raises:
        OutputError: If one cannot be written.
    """
    given = {one.frame: one.mask for one in corrections if isinstance(one.mask, np.ndarray)}
    if prompt is not None and prompt.mask is not None and prompt.points is None:
        given[first] = prompt.mask
    if given:
        with writing(folder):
            (folder / layout.PROMPTS).mkdir(exist_ok=True)
    for index, mask in given.items():
        write_mask(layout.prompt_path(folder, index), mask)


def repeat_masks(folder: Path, index: int | None, again: int) -> None:
    """Give frame ``again`` of a run the masks of frame ``index``, whose picture it repeats.

    Raises:
        OutputError: If one cannot be written.
    """
    of_frame = (layout.mask_path, layout.initial_mask_path, layout.probability_path)
    for inner, path_of in product((folder, folder / layout.CAUSAL), of_frame):
        if index is not None and (mask := path_of(inner, index)).is_file():
            write_atomic(path_of(inner, again), mask.read_bytes())


def read_given_mask(folder: Path, index: int) -> NDArray[np.bool_]:
    """The mask ``(H, W)`` that was given for a frame.

    Raises:
        InputError: If it is missing or damaged.
    """
    mask = read_mask(path := layout.prompt_path(folder, index))
    if mask is None:
        raise InputError(
            f"The mask {path} that was given to the run is missing or damaged; give it again with "
            "`tracking3d run` --resume, --mask and --correct."
        )
    return mask


if sys.platform == "win32":
    import msvcrt

    # Locks are mandatory there, so one byte is locked far beyond what is ever read.
    _BYTE = 2**30

    def _lock(descriptor: int, shared: bool) -> None:
        os.lseek(descriptor, _BYTE, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(descriptor: int, shared: bool) -> None:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def try_lock(descriptor: int, shared: bool = False) -> bool:
    """Lock an open file until it is closed; False if another open file holds it.

    A file system without locks counts as free.
    """
    return _try_lock(descriptor, shared) is not False


def is_locked(path: Path) -> bool | None:
    """Whether the lock on ``path`` is held; None on a file system without locks."""
    try:
        with path.open("rb") as file:
            free = _try_lock(file.fileno(), shared=True)
    except OSError:
        return False
    return None if free is None else not free


def _try_lock(descriptor: int, shared: bool) -> bool | None:
    """Whether the lock could be taken; None on a file system without locks."""
    try:
        _lock(descriptor, shared)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True
