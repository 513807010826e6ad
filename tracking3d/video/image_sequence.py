"""Frames from a folder of images or from a glob pattern."""

from __future__ import annotations

import filecmp
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.video.image_file import SUFFIXES, mode_of, read_exif_intrinsics, read_image
from tracking3d.video.source import EVERY_FRAME, Intrinsics, check_frames, natural_order, within


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


def frames_among(paths: Iterable[Path]) -> tuple[list[Path], tuple[str, ...]]:
    """The images among ``paths`` that are the frames of one video or set of photos, and a clause on each other kind.

    Files are of a kind if their names differ in numbers only. Depth images are left out where there are others. Of what
    is left the kind with most files is taken if it has half of them, and three; of two such kinds that in colour.
    """
    files = images_among(paths)
    kinds = defaultdict[str, list[Path]](list)
    for file in files:
        kinds[re.sub(r"\d+", "#", file.name.casefold())].append(file)
    if len(kinds) == 1:
        return files, ()
    modes = {name: mode_of(kind[0]) for name, kind in kinds.items()}
    depths = [kind for name, kind in kinds.items() if modes[name].startswith("I")]
    names = sorted(kinds, key=lambda name: (-len(kinds[name]), modes[name] in ("1", "L")))
    others = [kinds[name] for name in names if kinds[name] not in depths]
    if not others:
        return files, ()
    spare = others[1:] if len(others[0]) >= max(3, sum(map(len, others)) / 2) else []
    notes = [f"{_named(kind)} left out: 16-bit grey, as depth images are" for kind in depths]
    notes += [f"{_named(kind)} left out, since most images here have other names" for kind in spare]
    left_out = {file for kind in (*depths, *spare) for file in kind}
    return [file for file in files if file not in left_out], tuple(notes)


def _named(files: list[Path]) -> str:
    if len(files) == 1:
        return f"{files[0].name} is"
    return f"{len(files)} images such as {files[0].name} are"


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """Image files as the frames of a video.

    See `tracking3d.video.source.FrameSource` for the other attributes.
    """

    name: str
    files: tuple[Path, ...]
    selection: range
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    # images per second of all files, selected or not, which their times are counted by; None if not given
    rate: float | None = None
    repeatable: bool = True
    notes: tuple[str, ...] = ()
    distinct: frozenset[int] | None = None  # see `tracking3d.video.source.check_frames`

    @classmethod
    def open(
        cls, name: str, paths: Iterable[Path], selection: range = EVERY_FRAME, chosen: bool = False
    ) -> ImageSequence:
        """Take the images among ``paths`` in natural order; the first selected one tells about the lens.

        Args:
            name: What messages call the sequence: the folder or pattern as given.
            paths: Files of any kind; only images that are not hidden count.
            selection: Wanted indices into the ordered images.
            chosen: Whether a person chose exactly these images, by a pattern; see `frames_among` otherwise.

        Raises:
            InputError: If there is no image, or the selection leaves none.
        """
        files, notes = (images_among(paths), ()) if chosen else frames_among(paths)
        if not files:
            raise InputError(
                f"{name} holds no images; give a folder or pattern of {', '.join(sorted(SUFFIXES))} files."
            )
        wanted = within(selection, len(files))
        if not wanted:
            raise InputError(
                f"{name} has no frame {selection.start}, since its {len(files)} images count from 0; "
                "choose other frames."
            )
        intrinsics, origin = read_exif_intrinsics(files[wanted[0]]) or (None, "")
        return cls(name, tuple(files), wanted, intrinsics, origin, notes=notes)

    @property
    def fps(self) -> float | None:
        """Selected images per second, if given."""
        return None if self.rate is None else self.rate / self.selection.step

    @property
    def count(self) -> int:
        """Number of selected images."""
        return len(self.selection)

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Read the selected images; those that cannot be read are given as skipped."""
        return check_frames(self._frames(), self.name, self.distinct)

    def _frames(self) -> Iterator[Frame | SkippedFrame]:
        last: tuple[Path, Image] | None = None  # kept so that equal files are decoded once
        for index in self.selection:
            file = self.files[index]
            try:
                seconds = None if self.rate is None else index / self.rate
                image = last[1] if last and _are_equal(last[0], file) else read_image(file)
                last = None if self.distinct is None else (file, image)
                yield Frame(index, image, seconds, file.name)
            except InputError as error:
                yield SkippedFrame(index, str(error).removesuffix("."))


def _are_equal(one: Path, other: Path) -> bool:
    try:
        return filecmp.cmp(one, other, shallow=False)
    except OSError:  # `read_image` says why it cannot be read
        return False
