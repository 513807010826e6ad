"""Jobs in processes of their own: in order, with what they tell, and with their faults."""

from __future__ import annotations

import os

import pytest

from tracking3d.errors import InputError, Tracking3dError
from tracking3d.pipeline.submaps.split_run import run_in_processes


def where(tell, job):
    tell(job)
    return job, os.getpid()


def fail_or_crash(tell, job):
    if job == "fail":
        raise InputError("There is no such video.")
    if job == "crash":
        os._exit(3)
    return job


def test_one_worker_is_this_process():
    told = []
    assert run_in_processes(where, [3, 1], 1, told.append) == [(3, os.getpid()), (1, os.getpid())]
    assert told == [3, 1]
    assert run_in_processes(where, [], 4) == []


def test_several_are_others_and_answers_come_in_the_order_of_the_jobs():
    told = []
    estimates = run_in_processes(where, [3, 1, 2], 2, told.append)
    assert [job for job, _ in estimates] == [3, 1, 2]
    assert os.getpid() not in {process for _, process in estimates}
    assert sorted(told) == [1, 2, 3]
    assert "OMP_NUM_THREADS" not in os.environ or os.environ["OMP_NUM_THREADS"]


@pytest.mark.parametrize(
    ("jobs", "error", "said"),
    [(["fail", "well"], InputError, "no such video"), (["well", "crash"], Tracking3dError, "--resume")],
)
def test_a_fault_is_raised_here(jobs, error, said):
    with pytest.raises(error, match=said):
        run_in_processes(fail_or_crash, jobs, 2)
