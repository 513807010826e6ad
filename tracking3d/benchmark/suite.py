"""Variants on a dataset: every sequence of every variant is a job, all in one pool."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tracking3d.benchmark.job import Job
from tracking3d.benchmark.pool import Listener, run_jobs
from tracking3d.benchmark.results import ResultSet, collect
from tracking3d.benchmark.sequences import Dataset
from tracking3d.benchmark.variant import Variant, check_masks


def run_suite(
    variants: Sequence[Variant],
    dataset: Dataset,
    out: Path,
    processes: int = 1,
    listener: Listener = lambda outcome: None,
    address: str | None = None,
) -> list[ResultSet]:
    """Run every variant on every sequence; one result set a variant, in their order.

    Finished runs are saved in ``out`` and not repeated while configuration, masks, frames and code are the same.
    A sequence that fails is named in the result set. With the ``address`` of a Ray cluster the jobs run there.

    Raises:
        InputError: If a variant's source of masks does not exist.
    """
    for variant in variants:
        check_masks(variant.masks)
    jobs = [
        Job(dataset.layout, dataset.root, sequence, variant, out)
        for variant in variants
        for sequence in dataset.sequences
    ]
    outcomes = run_jobs(jobs, processes, listener, address)
    count = len(dataset.sequences)
    return [
        collect(variant, dataset, outcomes[n * count : (n + 1) * count]) for n, variant in enumerate(variants)
    ]
