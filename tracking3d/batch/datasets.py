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

    frames: tuple[Path, ...]  # the images
    box: Box | None  # the object in the first of them, if it is known
    given_camera: Camera | None  # the camera that a tracker is given, if that is not the true one
    camera: Camera | None  # the true camera
    camera_told: bool  # whether a tracker is given a camera at all

    def box_in_frame(self) -> Box | None:
        """The part of `box` inside the first frame."""
        ...


class Dataset(Protocol):
    """Sequences in a folder."""

    layout: str  # name of the layout, or the YAML file of one
    root: Path  # the folder
    sequences: tuple[str, ...]  # their names


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
