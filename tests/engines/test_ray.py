"""The same of Ray, for real: slow, as starting it takes many seconds; two nodes on this machine, one of which goes."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import engine_tasks as tasks
import pytest

from tracking3d.engines import on_ray
from tracking3d.engines.choosing import open_engine
from tracking3d.engines.mapping import map_tasks
from tracking3d.engines.on_ray import RayEngine
from tracking3d.engines.protocol import Began, Needs, ProgressReport, Task
from tracking3d.errors import InputError

pytestmark = [
    pytest.mark.slow,
    # Files and sockets that Ray leaves to the end of its processes.
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning"),
]


@pytest.fixture(scope="module")
def ray():
    return pytest.importorskip("ray", reason="the extra ray is not installed")


@pytest.fixture
def here(monkeypatch):
    """Workers of Ray find the functions of these tests."""
    paths = [str(Path(__file__).parent), str(Path.cwd()), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))


def test_faults_retries_and_stops_are_those_of_processes(ray, here, tmp_path):
    told = []
    with open_engine("local", 2, Needs(threads=1)) as engine:
        assert isinstance(engine, RayEngine) and engine.workers == 2
        jobs = [
            Task(1, tasks.square, (3,)),
            Task(2, tasks.fail, ("No such video.",)),
            Task(3, tasks.abort, log=tmp_path / "abort.log"),
            Task(4, tasks.killed_once, (tmp_path / "killed",)),
            Task(5, tasks.variable, ("OPENBLAS_CORETYPE",), environment={"OPENBLAS_CORETYPE": "Haswell"}),
        ]
        ended = map_tasks(engine, jobs, retries=1, pause=0.0, listener=told.append)
        assert ended[1].value == 9
        assert ended[2].fault.reason == "No such video." and not ended[2].fault.crashed
        assert ended[3].fault.crashed and "Aborted; see" in ended[3].fault.reason
        assert ended[4].value == "done" and ended[4].attempts == 2
        assert ended[5].value == "Haswell"
        began = [event.number for event in told if isinstance(event, Began)]
        assert sorted(began) == [1, 2, 2, 3, 3, 4, 4, 5]  # once for every attempt

        note = tmp_path / "note"

        def interrupt(event):
            if isinstance(event, ProgressReport):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            map_tasks(engine, [Task(6, tasks.told_to_stop, (note,))], listener=interrupt)
        assert note.read_text() == "stopped"


def test_a_node_that_goes_costs_nothing_but_time(ray, here, tmp_path):
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 10**8})
    second = cluster.add_node(num_cpus=1, object_store_memory=10**8)
    removed = False

    def remove(event):
        nonlocal removed
        if (
            isinstance(event, ProgressReport) and event.content == second.node_id
        ):  # for three seconds from now on
            cluster.remove_node(second, allow_graceful=False)
            removed = True

    try:
        with open_engine(cluster.address, 2) as engine:
            jobs = [Task(n, tasks.node, (3.0,)) for n in range(6)]
            ended = map_tasks(engine, jobs, retries=2, pause=0.0, listener=remove)
    finally:
        cluster.shutdown()
    assert removed
    assert [ended[n].fault for n in range(6)] == [None] * 6
    assert max(one.attempts for one in ended.values()) >= 2


def test_a_server_that_is_no_ray_is_told_in_a_sentence(ray, monkeypatch, capfd):
    monkeypatch.setattr(on_ray, "RESPONSE", 3.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(InputError, match="no response in 3 seconds"), open_engine(address, 2):
            pass
    assert capfd.readouterr() == ("", "")
