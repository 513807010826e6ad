"""The simulation of many videos over many workers, against bounds that hold of every schedule."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fleet_simulation import ORDERS, Fleet, Splitting, simulate, skewed_lengths
from tracking3d.errors import InputError

CALM = {"slow": 0.0, "losses": 0.0}


def best_makespan(work: list[float], workers: int) -> float:
    """By trying every way to give tasks to workers."""
    return min(
        max(sum(w for w, own in zip(work, given, strict=True) if own == worker) for worker in range(workers))
        for given in itertools.product(range(workers), repeat=len(work))
    )


@pytest.mark.parametrize("order", ORDERS)
def test_one_worker_takes_the_sum(order):
    outcome = simulate([3.0, 1.0, 2.0], Fleet(1, **CALM), order)
    assert outcome.makespan == pytest.approx(6)
    assert outcome.busy == pytest.approx(1)
    assert outcome.attempts == 3
    assert (outcome.wasted, outcome.given_up) == (0, 0)


def test_videos_end_in_the_order_that_was_asked_for():
    work = [3.0, 1.0, 2.0]
    assert simulate(work, Fleet(1, **CALM), "first").ends.tolist() == [3, 4, 6]
    assert simulate(work, Fleet(1, **CALM), "longest").ends.tolist() == [3, 6, 5]


@pytest.mark.parametrize("seed", range(6))
def test_greedy_schedules_keep_to_graham_s_bounds(seed):
    """Graham 1969: any order is within 2 - 1/m of the best, longest first within 4/3 - 1/(3m)."""
    work = np.random.default_rng(seed).uniform(1, 10, 8).tolist()
    best = best_makespan(work, 3)
    for order, bound in {"first": 2 - 1 / 3, "random": 2 - 1 / 3, "longest": 4 / 3 - 1 / 9}.items():
        makespan = simulate(work, Fleet(3, **CALM), order).makespan
        assert best - 1e-9 <= makespan <= bound * best + 1e-9


def test_longest_first_keeps_the_last_long_one_from_waiting():
    work = [*([1.0] * 40), 10.0]
    assert simulate(work, Fleet(5, **CALM), "longest").makespan == pytest.approx(10)
    assert simulate(work, Fleet(5, **CALM), "first").makespan == pytest.approx(18)


def test_parts_make_one_long_video_as_short_as_their_sum_over_the_workers():
    splitting = Splitting(seconds=25.0, look_ahead=0.1, overlap=0.0, join=0.2)
    outcome = simulate([100.0], Fleet(4, **CALM), splitting=splitting)
    assert outcome.makespan == pytest.approx(10 + 80 / 4 + 20)
    assert outcome.attempts == 1 + 4 + 1
    assert simulate([49.0], Fleet(4, **CALM), splitting=splitting).attempts == 1


def test_overlaps_are_work_too():
    splitting = Splitting(seconds=25.0, look_ahead=0.0, overlap=5.0, join=0.0)
    outcome = simulate([100.0], Fleet(1, **CALM), splitting=splitting)
    assert outcome.makespan == pytest.approx(100 + 3 * 5)


@pytest.mark.parametrize("resumes", [True, False])
def test_what_lost_workers_did_is_kept_or_done_again(resumes):
    work = [3600.0] * 20
    fleet = Fleet(5, slow=0, losses=0.3, replaced=0, resumes=resumes, retries=1000)
    outcome = simulate(work, fleet, seed=1)
    assert outcome.given_up == 0
    assert np.isfinite(outcome.ends).all()
    assert outcome.attempts > 20
    worked = outcome.busy * outcome.makespan * fleet.workers
    assert worked == pytest.approx(sum(work) + outcome.wasted)
    assert (outcome.wasted == 0) == resumes


def test_a_task_is_given_up_after_its_retries():
    outcome = simulate([1e6], Fleet(1, slow=0, losses=3600, retries=2))
    assert (outcome.given_up, outcome.attempts, outcome.makespan) == (1, 3, 0.0)
    parts = simulate([1e6], Fleet(3, slow=0, losses=3600, retries=2), splitting=Splitting(1e5))
    assert parts.given_up == 1


def test_slow_workers_take_longer():
    assert simulate([10.0], Fleet(1, slow=1, slowness=3, losses=0)).makespan == pytest.approx(30)


@pytest.mark.parametrize("order", ORDERS)
def test_no_more_workers_work_than_there_are_and_none_is_idle_while_tasks_wait(order):
    work = skewed_lengths(200)
    outcome = simulate(work, Fleet(10, **CALM), order)
    assert outcome.working[:, 1].max() == 10
    assert outcome.working[-1, 1] == 0
    assert outcome.makespan >= max(work.max(), work.sum() / 10) - 1e-6
    assert outcome.busy * outcome.makespan * 10 == pytest.approx(work.sum())


def test_the_same_seed_is_the_same_run():
    work, fleet = skewed_lengths(300), Fleet(20)
    one, other = (simulate(work, fleet, "random", Splitting(100.0), seed=4) for _ in range(2))
    np.testing.assert_array_equal(one.ends, other.ends)
    assert not np.array_equal(one.ends, simulate(work, fleet, "random", Splitting(100.0), seed=5).ends)


def test_splitting_ends_the_tail_of_long_videos():
    work = 15 * skewed_lengths(1000)
    whole = simulate(work, Fleet(100, **CALM))
    parts = simulate(work, Fleet(100, **CALM), splitting=Splitting(900.0))
    assert parts.makespan < 0.8 * whole.makespan


@pytest.mark.parametrize(
    ("work", "fleet"),
    [
        ([0.0], Fleet()),
        ([float("nan")], Fleet()),
        ([-1.0], Fleet()),
        ([1.0], Fleet(0)),
        ([1.0], Fleet(slow=2)),
    ],
)
def test_numbers_without_sense_are_refused(work, fleet):
    with pytest.raises(InputError):
        simulate(work, fleet)


@pytest.mark.parametrize("wrong", [Splitting(0), Splitting(10, overlap=-1), Splitting(10, join=1)])
def test_parts_without_sense_are_refused(wrong):
    with pytest.raises(InputError):
        simulate([1.0], Fleet(), splitting=wrong)


def test_no_videos_take_no_time():
    assert simulate([], Fleet()).makespan == 0
