"""Sequences of datasets as videos of a batch; what reads them is another package, found by its entry point."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Protocol

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.geometry.camera import Camera
from tracking3d.runtime.moved_modules import bench_is_missing

DATASET_READERS = "tracking3d.dataset_readers"
"""Entry-point group of what reads datasets: the value of the entry point ``reader`` is a `DatasetReader`."""


class DatasetSequence(Protocol):
    """What a tracker is given of a sequence."""

    @property
    def frames(self) -> tuple[Path, ...]:
        """The images."""
        ...

    @property
    def box(self) -> Box | None:
        """The object in the first of them, if it is known."""
        ...

    @property
    def given_camera(self) -> Camera | None:
        """The camera that a tracker is given, if that is not the true one."""
        ...

    @property
    def camera(self) -> Camera | None:
        """The true camera."""
        ...

    @property
    def camera_told(self) -> bool:
        """Whether a tracker is given a camera at all."""
        ...

    def box_in_frame(self) -> Box | None:
        """The part of `box` inside the first frame."""
        ...


class Dataset(Protocol):
    """Sequences in a folder."""

    @property
    def layout(self) -> str:
        """Name of the layout, or the YAML file of one."""
        ...

    @property
    def root(self) -> Path:
        """The folder."""
        ...

    @property
    def sequences(self) -> tuple[str, ...]:
        """Names of the sequences."""
        ...


class DatasetReader(Protocol):
    """Reads datasets of known layouts."""

    def open_sequences(self, name: str, data: Path, patterns: Sequence[str]) -> Dataset:
        """The sequences of a dataset in the folder ``data`` that match any of the patterns, all without a pattern."""
        ...

    def read_sequence(self, layout: str, root: Path, name: str) -> DatasetSequence:
        """A sequence."""
        ...


def dataset_reader() -> DatasetReader:
    """What reads datasets on this machine.

    Raises:
        InputError: Nothing that does is installed.
    """
    for point in metadata.entry_points(group=DATASET_READERS, name="reader"):
        reader: DatasetReader = point.load()
        return reader
    raise InputError(bench_is_missing("What reads datasets"))
