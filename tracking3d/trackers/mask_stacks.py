"""Masks in one file: numpy arrays, or a video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.runtime.array_files import ArrayFile, ArrayTooLargeError
from tracking3d.trackers.array_planes import MappedPlanes, NamedPlanes, Planes, StackedPlanes, read_plane
from tracking3d.trackers.mask_images import UnreadableMaskError, binarize, natural_key


class ArrayMasks:
    """Masks in an ``.npy`` or ``.npz`` file, never unpickled, each read when it is asked for.

    One array ``(N, H, W)`` of all masks, or in an ``.npz`` one array ``(H, W)`` under each frame's name.

    Raises:
        InputError: If the file cannot be read, holds no such arrays, or a mask is larger than a frame can be.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: Sequence[str] = ()
        try:
            self._arrays = self._open()
            read_plane(self._arrays, 0)
        except ArrayTooLargeError as error:
            raise InputError(
                f"{path} holds masks that are larger than a frame can be ({error}); give masks of the frames' size."
            ) from error
        except Exception as error:  # zip, header, shape and dtype errors alike
            raise InputError(
                f"{path} holds no masks; store an array (N, H, W) of numbers or booleans, or in an .npz one "
                "array (H, W) under each frame's name."
            ) from error

    def _open(self) -> Planes:
        with self._path.open("rb") as file:
            if file.read(4) != b"PK\x03\x04":
                return MappedPlanes(self._path)
        archive = ArrayFile(self._path)
        names = sorted(archive.names, key=natural_key)
        if len(names) == 1 and len(archive.header(names[0]).shape) > 2:
            return StackedPlanes(archive, names[0])
        self.names = [Path(name).stem for name in names]
        return NamedPlanes(archive, names)

    def label(self, position: int) -> str:
        """The file's path and the array's name or number."""
        return f"{self._path} [{self.names[position] if self.names else position}]"

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`."""
        if position >= len(self._arrays):
            return None
        try:
            return binarize(read_plane(self._arrays, position))
        except ArrayTooLargeError as error:
            raise UnreadableMaskError(
                f"{self.label(position)} is larger than a frame can be ({error})"
            ) from error
        except Exception as error:  # a damaged member of the archive, or one of another shape
            raise UnreadableMaskError(f"{self.label(position)} cannot be read") from error


class VideoMasks:
    """A video whose frames are the masks, decoded forward as they are asked for.

    Raises:
        InputError: If the file is no video.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: Sequence[str] = ()
        self._restart()
        try:
            self._advance()
        except Exception as error:  # av raises many kinds
            raise InputError(
                f"{path} cannot be read as masks; give a folder of images, a video, an .npz or an .npy file."
            ) from error
        if self._mask is None:
            raise InputError(f"The video {path} has no frame that can be read as a mask.")

    def label(self, position: int) -> str:
        """The file's path and the frame's number."""
        return f"{self._path} [{position}]"

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`; going back decodes again from the start."""
        if position < self._position:
            self._restart()
        try:
            while self._position < position and self._mask is not None:
                self._advance()
        except av.FFmpegError as error:
            raise UnreadableMaskError(f"{self.label(position)} cannot be decoded") from error
        return self._mask

    def _restart(self) -> None:
        self._frames = _grey_frames(self._path)
        self._position = -1
        self._mask: NDArray[np.bool_] | None = np.zeros((1, 1), bool)

    def _advance(self) -> None:
        grey = next(self._frames, None)
        self._position += 1
        self._mask = None if grey is None else grey > 127


def _grey_frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield np.asarray(frame.to_ndarray(format="gray"), np.uint8)
