"""Variants on a dataset: every sequence of every variant is a job, all in one pool."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d_bench.benchmark.input_change import InputChange
from tracking3d_bench.benchmark.job import Job
from tracking3d_bench.benchmark.pool import Listener, run_jobs
from tracking3d_bench.benchmark.results import ResultSet, collect
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.variant import Variant, check_masks


def run_suite(
    variants: Sequence[Variant],
    dataset: Dataset,
    out: Path,
    processes: int = 1,
    listener: Listener = lambda outcome: None,
    address: str | None = None,
) -> list[ResultSet]:
    """Run every variant on every sequence; one result set a variant, in their order.

    A sequence for which a variant's change of the input means nothing is missing from that variant's results.
    Finished runs are saved in ``out`` and not repeated while configuration, masks, frames and code are the same.
    A sequence that fails is named in the result set. With the ``address`` of a Ray cluster the jobs run there.

    Raises:
        InputError: If a variant's source of masks does not exist.
    """
    for variant in variants:
        check_masks(variant.masks)
    jobs = [
        [
            job
            for sequence in dataset.sequences
            if _can_be_changed(job := Job(dataset.layout, dataset.root, sequence, variant, out))
        ]
        for variant in variants
    ]
    outcomes = iter(run_jobs([job for of_one in jobs for job in of_one], processes, listener, address))
    return [
        collect(variant, dataset, list(islice(outcomes, len(of_one))))
        for variant, of_one in zip(variants, jobs, strict=True)
    ]


def _can_be_changed(job: Job) -> bool:
    """Whether the sequence can be run with the variant's changes; one that cannot be read fails when it is run."""
    if job.variant.input == InputChange():
        return True
    try:
        return not job.variant.input.reason_against(job.unchanged_truth, job.variant.masks)
    except InputError:
        return True
