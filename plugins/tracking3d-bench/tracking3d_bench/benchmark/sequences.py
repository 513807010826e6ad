"""From the name of a dataset to its sequences: synthetic suites, real clips, and datasets in any layout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d_bench.datasets import reading
from tracking3d_bench.datasets.layout import load_layout
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.suite import SUITE_VERSION, is_suite, make_suite

REAL = "real"


@dataclass(frozen=True)
class Dataset:
    """Sequences to be run."""

    name: str  # what results call it
    version: int | None  # version of a synthetic suite; None for others
    layout: str  # name of the layout, or the YAML file of one
    root: Path  # folder of the dataset
    sequences: tuple[str, ...]  # names of the sequences

    @property
    def synthetic(self) -> bool:
        """Whether it is one of the suites that this package makes."""
        return self.version is not None

    def only(self, patterns: list[str]) -> Dataset:
        """The sequences that match any of the patterns, all if there is no pattern.

        Raises:
            InputError: If a pattern matches nothing.
        """
        for pattern in patterns:
            if not any(fnmatch(name, pattern) for name in self.sequences):
                raise InputError(
                    f"{self.name} has no sequence '{pattern}'; choose from {', '.join(self.sequences)}."
                )
        chosen = tuple(
            name for name in self.sequences if not patterns or any(fnmatch(name, one) for one in patterns)
        )
        return Dataset(self.name, self.version, self.layout, self.root, chosen)


def open_dataset(
    name: str,
    data: Path | None,
    out: Path,
    jobs: int,
    listener: Callable[[str], None] = lambda name: None,
    specs: Sequence[SequenceSpec] | None = None,
) -> Dataset:
    """Find a dataset by name; a synthetic suite that is not there yet is made.

    Args:
        name: One of the fixed suites; ``fresh-SEED`` or ``phone-SEED``; ``real`` for a folder of clips in our own
            layout; the name of a dataset's layout; or a YAML file of one.
        data: Folder of the dataset; a synthetic suite's default is ``out/data/NAME``.
        out: Folder of the benchmark.
        jobs: Processes that make a suite.
        listener: Called for every sequence of a suite when it is made.
        specs: The sequences of a suite that is none of these but called ``name``.

    Raises:
        InputError: If there is no such dataset, or it holds no sequence.
    """
    if specs is not None or is_suite(name):
        folder = data or out / "data" / name
        made = make_suite(name, folder, specs=specs, jobs=jobs, listener=listener)
        return Dataset(name, SUITE_VERSION, "clip", folder, tuple(path.name for path in made))
    if data is None:
        raise InputError(f"Give the folder of the dataset {name}: --data DIR.")
    layout = "clip" if name == REAL else name
    sequences = tuple(reading.list_sequences(load_layout(layout), data))
    if not sequences:
        raise InputError(f"{data} holds no sequence of the dataset {name}; give its folder with --data.")
    return Dataset(Path(name).stem, None, layout, data, sequences)


def open_sequences(name: str, data: Path, patterns: Sequence[str]) -> Dataset:
    """For `tracking3d.batch.datasets.DatasetReader`, which this module is.

    Raises:
        InputError: If there is no such dataset, or a pattern matches nothing.
    """
    return open_dataset(name, data, data, 1).only(list(patterns))


def read_sequence(layout: str, root: Path, name: str) -> Truth:
    """The same.

    Raises:
        Tracking3dError: If there is no such layout or sequence, or it cannot be read.
    """
    return reading.read_sequence(load_layout(layout), root, name)
