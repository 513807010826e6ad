"""What is done beside the frames: in order, bounded, and what goes wrong there is raised where it is asked for."""

from __future__ import annotations

import threading
from contextlib import closing
from functools import partial

import pytest

from tracking3d.runtime.concurrency import (
    BackgroundWriter,
    OrderedExecutor,
    read_ahead,
    start_in_thread,
    with_next,
)


def test_items_come_in_order_from_another_thread():
    threads = set()

    def items():
        for number in range(20):
            threads.add(threading.current_thread())
            yield number

    assert list(read_ahead(items())) == list(range(20))
    assert threading.current_thread() not in threads and len(threads) == 1


def test_no_more_is_read_ahead_than_was_said():
    read = []
    before = set(threading.enumerate())

    def items():
        for number in range(20):
            read.append(number)
            yield number

    with closing(read_ahead(items(), most=2)) as ahead:
        for number in ahead:
            assert len(read) <= number + 1 + 2
            if number == 5:
                break
    assert len(read) <= 8
    left = set(threading.enumerate()) - before
    assert not [one for one in left if one.name.startswith("tracking3d-reading")]


@pytest.mark.parametrize("error", [ValueError("frame 2"), KeyboardInterrupt()])
def test_an_error_comes_behind_the_items_before_it(error):
    def items():
        yield from (0, 1)
        raise error

    taken = []
    with pytest.raises(type(error)):
        for item in read_ahead(items(), most=4):
            taken.append(item)
    assert taken == [0, 1]


@pytest.mark.parametrize(
    ("items", "pairs"), [([], []), ([1], [(1, None)]), ([1, 2, 3], [(1, 2), (2, 3), (3, None)])]
)
def test_every_item_comes_with_the_next(items, pairs):
    assert list(with_next(items)) == pairs


def test_without_a_thread_a_job_is_done_where_it_is_given():
    work = BackgroundWriter()
    assert work.do(threading.current_thread) is threading.current_thread()
    assert work.wait() is None


def test_jobs_are_done_one_at_a_time_behind_the_caller():
    work, done, gate = BackgroundWriter(), [], threading.Event()
    work.threaded = True

    def first():
        gate.wait(10)
        done.append("first")
        return 1

    assert work.do(first) is None
    assert done == []
    gate.set()
    assert work.do(lambda: done.append("second") or 2) == 1
    assert work.wait() == 2 and done == ["first", "second"]
    work.end()


def test_a_job_that_fails_is_told_of_once_and_the_next_is_not_begun():
    work, done = BackgroundWriter(), []
    work.threaded = True
    work.do(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        work.do(lambda: done.append("never"))
    assert work.wait() is None and done == []
    work.do(lambda: 1 / 0)
    work.end()  # what ends for another reason does not hear of it
    assert work.do(lambda: 3) == 3  # where it is given, from now on


@pytest.mark.parametrize("most", [1, 2, 3])
def test_jobs_done_several_at_a_time_give_their_results_in_order(most):
    jobs, begun, found = OrderedExecutor(most), [], []
    let_go = [threading.Event() for _ in range(9)]

    def job(number):
        begun.append(number)
        if number % most:  # the first of each round waits for the last
            let_go[number - number % most].set()
        elif most > 1:
            assert let_go[number].wait(10)
        return number

    for number in range(9 - 9 % most):
        found += jobs.do(partial(job, number))
        assert len(begun) <= len(found) + most
    found += jobs.rest()
    assert found == sorted(begun) == list(range(9 - 9 % most))
    assert not [one for one in threading.enumerate() if one.name.startswith("tracking3d-in-turn")]


def test_an_error_of_one_of_several_jobs_comes_in_its_turn():
    def fail():
        raise ValueError("job 1")

    jobs = OrderedExecutor(2)
    assert [*jobs.do(lambda: 0), *jobs.do(fail)] == []
    assert list(jobs.do(lambda: 2)) == [0]
    with pytest.raises(ValueError, match="job 1"):
        list(jobs.rest())


@pytest.mark.parametrize("threads", [1, 2])
def test_a_job_beside_gives_its_result_or_raises_when_it_is_asked(threads):
    where = []

    def job() -> int:
        where.append(threading.current_thread())
        return 7

    assert start_in_thread(job, threads)() == 7
    assert (where[0] is threading.current_thread()) == (threads == 1)


def test_an_error_of_a_job_beside_is_raised_when_its_result_is_asked_for():
    result = start_in_thread(lambda: 1 / 0, 2)
    with pytest.raises(ZeroDivisionError):
        result()
