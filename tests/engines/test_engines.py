"""Engines do tasks and outlive what kills a worker; the loop tries again, and knows when to stop."""

from __future__ import annotations

import os
import signal
import time

import engine_tasks as tasks
import pytest

from tracking3d.engines.choosing import InThisProcess, open_engine
from tracking3d.engines.mapping import map_tasks
from tracking3d.engines.processes import ProcessEngine, default_workers
from tracking3d.engines.protocol import Began, Ended, Fault, Needs, ProgressReport, Task
from tracking3d.errors import InputError


def test_results_come_by_number_and_everything_is_told(engine, tmp_path):
    told = []
    jobs = [Task(n, tasks.square, (n,), tmp_path / f"{n}.log") for n in (3, 1, 2)]
    ended = map_tasks(engine, jobs, listener=told.append)
    assert {number: one.value for number, one in ended.items()} == {1: 1, 2: 4, 3: 9}
    for number in (1, 2, 3):
        own = [type(event) for event in told if event.number == number]
        assert own == [Began, ProgressReport, Ended]
        assert (tmp_path / f"{number}.log").read_text() == f"squared {number}\n"


def test_what_fails_is_a_fault_in_one_sentence_and_costs_nothing_else(engine):
    jobs = [Task(1, tasks.fail, ("No such\n video.",)), Task(2, tasks.leave), Task(3, tasks.square, (3,))]
    ended = map_tasks(engine, jobs)
    assert ended[1].fault == Fault("No such video.")
    assert ended[2].fault == Fault("SystemExit: 3")
    assert ended[3].value == 9


def test_a_process_that_aborts_costs_its_own_task_and_its_last_words_are_told(tmp_path):
    jobs = [Task(1, tasks.abort, log=tmp_path / "log.txt"), Task(2, tasks.square, (2,))]
    ended = map_tasks(ProcessEngine(1), jobs)
    assert ended[2].value == 4
    fault = ended[1].fault
    assert fault.crashed and "signal 6" in fault.reason
    assert "the last words" in fault.reason and "log.txt" in fault.reason


def test_a_killed_worker_is_replaced_and_its_task_is_tried_again(tmp_path):
    told = []
    job = Task(1, tasks.killed_once, (tmp_path / "note",))
    ended = map_tasks(ProcessEngine(1), [job], retries=1, pause=0.0, listener=told.append)
    assert ended[1].value == "done" and ended[1].attempts == 2
    first, last = (event for event in told if isinstance(event, Ended))
    assert first.again and first.fault.crashed and not last.again
    assert [event.attempt for event in told if isinstance(event, Began)] == [1, 2]


def test_what_never_succeeds_is_tried_so_often_and_no_more(engine):
    told = []
    ended = map_tasks(engine, [Task(1, tasks.fail, ("no",))], retries=2, pause=0.0, listener=told.append)
    assert ended[1].attempts == 3 and ended[1].fault is not None
    assert sum(isinstance(event, Ended) for event in told) == 3


def test_a_task_may_lead_to_more(engine):
    def further(ended):
        return [Task(2, tasks.square, (ended.value,))] if ended.number == 1 else []

    ended = map_tasks(engine, [Task(1, tasks.square, (3,))], further=further)
    assert ended[2].value == 81


def test_what_goes_on_is_begun_before_what_has_not_begun():
    begun = []

    def listener(event):
        if isinstance(event, Began):
            begun.append(event.number)

    def further(ended):
        return [Task(number, tasks.square, (1,)) for number in (10, 11) if ended.number == 1]

    map_tasks(
        InThisProcess(), [Task(n, tasks.square, (n,)) for n in (1, 2)], listener=listener, further=further
    )
    assert begun == [1, 10, 11, 2]


def test_what_stops_the_loop_lets_tasks_keep_what_is_done(tmp_path):
    note = tmp_path / "note"

    def interrupt(event):
        if isinstance(event, ProgressReport):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        map_tasks(ProcessEngine(2), [Task(1, tasks.told_to_stop, (note,))], listener=interrupt)
    assert note.read_text() == "stopped"


def test_a_worker_whose_master_is_gone_stops(tmp_path):
    engine = ProcessEngine(1)
    note = tmp_path / "note"
    engine.start(Task(1, tasks.told_to_stop, (note,)))
    while not any(isinstance(event, ProgressReport) for event in engine.wait(1.0)):
        pass
    running = engine._running[1]
    running.connection.close()
    running.process.join(30)
    assert note.read_text() == "stopped"
    engine.stop()


def test_a_worker_has_its_share_of_threads_the_environment_and_the_folder_of_the_caller(
    tmp_path, monkeypatch
):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("TRACKING3D_OF_A_TEST", "set")
    engine = ProcessEngine(1, Needs(threads=1))
    job = Task(1, tasks.surroundings, ("TRACKING3D_OF_A_TEST", "OMP_NUM_THREADS"))
    assert map_tasks(engine, [job])[1].value == ("set", "1", 1, 1, "here")


def test_variables_that_libraries_read_when_imported_are_there_before(tmp_path, monkeypatch):
    monkeypatch.delenv("OPENBLAS_CORETYPE", raising=False)
    job = Task(1, tasks.variable, ("OPENBLAS_CORETYPE",), environment={"OPENBLAS_CORETYPE": "Haswell"})
    assert map_tasks(ProcessEngine(1), [job])[1].value == "Haswell"
    assert "OPENBLAS_CORETYPE" not in os.environ


def test_as_many_workers_as_the_cores_are_enough_for(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert default_workers(Needs()) == 8
    assert default_workers(Needs(threads=3)) == 2
    assert default_workers(Needs(threads=16)) == 1
    assert default_workers(Needs(memory=1e9)) == 1


def test_without_an_address_this_machine_works_and_with_one_ray_is_asked_for(monkeypatch):
    with open_engine(None, 3) as engine:
        assert isinstance(engine, ProcessEngine) and engine.workers == 3
    from tracking3d.engines import on_ray

    on_ray._ray.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(InputError, match=r"tracking3d\[ray\]"), open_engine("auto"):
        pass
    on_ray._ray.cache_clear()


def test_an_engine_in_this_process_has_one_task_at_a_time():
    engine = InThisProcess()
    assert engine.workers == 1 and engine.wait(0) == []
    started = time.monotonic()
    engine.stop()
    assert time.monotonic() - started < 60 and signal.getsignal(signal.SIGTERM) is not None
