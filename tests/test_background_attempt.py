"""Long work in another thread catches up with what has come meanwhile."""

from __future__ import annotations

import threading

import pytest

from tracking3d.runtime.background_attempt import BackgroundAttempt

PATIENCE = 60.0
"""Seconds until a test fails because a thread hangs."""


def after(released: threading.Event, *results: int) -> tuple[str, list[int]]:
    """The outcome of long work, when it is released."""
    assert released.wait(PATIENCE)
    return "state", list(results)


def test_of_many_items_some_are_worked_off_and_the_newest_always():
    released, caught = threading.Event(), []

    def catch_up(state: str, some: list[int]) -> tuple[str, list[int]]:
        caught.append(list(some))
        return state + "!", list(some)

    work = BackgroundAttempt(lambda: after(released, -1), catch_up)
    assert not work.is_done()
    for number in range(30):
        work.add(number)
    released.set()
    assert work.is_done(PATIENCE)
    assert len(caught) == 1 and len(caught[0]) == 10 and caught[0][-1] == 29
    assert caught[0] == sorted(caught[0])
    outcome = work.outcome()
    assert (outcome.state, outcome.results, outcome.left) == ("state!", [-1, *caught[0]], [])


def test_a_few_items_are_left_to_the_caller():
    released = threading.Event()
    work = BackgroundAttempt(lambda: after(released, -1), lambda state, some: (state, []))
    for number in range(2):
        work.add(number)
    released.set()
    assert work.is_done(None)
    work.add(2)
    assert work.outcome().left == [0, 1, 2]


def test_nothing_is_caught_up_with_if_the_attempt_fails():
    released = threading.Event()
    work = BackgroundAttempt(lambda: after(released), lambda state, some: pytest.fail("there is no state"))
    for number in range(9):
        work.add(number)
    released.set()
    assert work.is_done(PATIENCE)
    outcome = work.outcome()
    assert outcome.results == [] and outcome.left == list(range(9))


def test_an_error_is_raised_where_the_outcome_is_asked_for():
    def fail() -> tuple[str, list[int]]:
        raise ValueError("something is wrong")

    work: BackgroundAttempt[str, int, int] = BackgroundAttempt(fail, lambda state, some: (state, []))
    assert work.is_done(PATIENCE)
    with pytest.raises(ValueError, match="something is wrong"):
        work.outcome()


def test_the_outcome_is_the_same_if_it_is_asked_again():
    released = threading.Event()
    work = BackgroundAttempt(lambda: after(released, -1), lambda state, some: (state, []))
    work.add(0)
    released.set()
    assert work.is_done(PATIENCE)
    assert work.outcome().left == work.outcome().left == [0]
