"""Frames from a folder of images or from a glob pattern."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video.image_file import SUFFIXES, read_exif_intrinsics, read_image
from tracking3d.video.selection import EVERY_FRAME, natural_order, within
from tracking3d.video.source import Intrinsics, checked


def images_among(paths: Iterable[Path]) -> list[Path]:
    """The image files among ``paths`` in natural order, hidden ones left out."""
    return sorted(
        (
            path
            for path in paths
            if path.suffix.casefold() in SUFFIXES and not path.name.startswith(".") and path.is_file()
        ),
        key=natural_order,
    )


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """Image files as the frames of a video.

    See `tracking3d.video.source.FrameSource` for the other attributes.

    Attributes:
        rate: Images per second of all files, selected or not, which their times are counted by; None where nobody
            knows.
    """

    name: str
    files: tuple[Path, ...]
    selection: range
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    rate: float | None = None
    repeatable: bool = True

    @classmethod
    def open(cls, name: str, paths: Iterable[Path], selection: range = EVERY_FRAME) -> ImageSequence:
        """Take the images among ``paths`` in natural order; the first selected one tells about the lens.

        Args:
            name: What messages call the sequence: the folder or pattern as given.
            paths: Files of any kind; only images that are not hidden count.
            selection: Wanted indices into the ordered images.

        Raises:
            InputError: If there is no image, or the selection leaves none.
        """
        files = tuple(images_among(paths))
        if not files:
            raise InputError(
                f"{name} holds no image; give a folder or pattern of {', '.join(sorted(SUFFIXES))} files."
            )
        wanted = within(selection, len(files))
        if not wanted:
            raise InputError(
                f"{name} has no frame {selection.start}, since its {len(files)} images count from 0; "
                "choose other frames."
            )
        intrinsics, origin = read_exif_intrinsics(files[wanted[0]]) or (None, "")
        return cls(name, files, wanted, intrinsics, origin)

    @property
    def fps(self) -> float | None:
        """Selected images per second, where somebody has said."""
        return None if self.rate is None else self.rate / self.selection.step

    @property
    def count(self) -> int:
        """Number of selected images."""
        return len(self.selection)

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Read the selected images; those that cannot be read are given as skipped."""
        return checked(self._frames(), self.name)

    def _frames(self) -> Iterator[Frame | SkippedFrame]:
        for index in self.selection:
            file = self.files[index]
            try:
                seconds = None if self.rate is None else index / self.rate
                yield Frame(index, read_image(file), seconds, file.name)
            except InputError as error:
                yield SkippedFrame(index, str(error).removesuffix("."))
