"""The engine of many machines: tasks of Ray, each with what it needs, on a cluster or on this machine.

Ray's own retries are off: what is to be done again is decided in one place, `tracking3d.engines.mapping`.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tracking3d.engines.processes import default_workers
from tracking3d.engines.protocol import ONE_CORE, Began, Ended, Event, Fault, Needs, ProgressReport, Task
from tracking3d.engines.worker import call, last_words, threads_in_words
from tracking3d.errors import InputError

THIS_MACHINE = "local"
"""Address of a local Ray that is started for the batch and stopped with it."""

GRACE = 20.0
"""Seconds that a stopped task has to save its state."""

RESPONSE = 20.0
"""Seconds that a cluster has to respond."""

_CALLS = 20
"""Number of tasks after which a worker is replaced, to release memory held by libraries."""
_OBJECT_STORE = 100 * 2**20  # bytes; results are short, videos and run folders pass through files
_VARIABLES = "TRACKING3D_"
_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DEDUP_LOGS": "0",
}


@contextmanager
def open_ray(address: str, workers: int | None = None, needs: Needs = ONE_CORE) -> Iterator[RayEngine]:
    """Connect to a cluster, or start Ray on this machine; a Ray that runs in this process already is taken.

    Args:
        address: ``local``; ``auto`` for the cluster that this machine belongs to; ``HOST:PORT``; or
            ``ray://HOST:PORT`` from outside of the cluster.
        workers: Tasks at a time; as many as the cluster has cores for if None.
        needs: What each takes.

    Raises:
        InputError: If Ray is not installed, or no cluster responds at the address within `RESPONSE`.
    """
    os.environ.update({name: os.environ.get(name, value) for name, value in _QUIET.items()})
    ray = _ray()
    if ray.is_initialized():
        yield RayEngine(workers, needs)
        return
    begun: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address == THIS_MACHINE:
        cores = (workers or default_workers(needs)) * needs.threads
        begun |= {"num_cpus": cores, "include_dashboard": False, "object_store_memory": _OBJECT_STORE}
    else:
        begun["address"] = address
        if fault := fault_of_cluster(address, RESPONSE):
            raise _no_cluster(address, fault)
    with _signals_kept():
        try:
            ray.init(**begun)
        except Exception as error:  # a cluster can be out of reach in many ways
            raise _no_cluster(address, str(error)) from error
    _silence()
    try:
        yield RayEngine(workers, needs)
    finally:
        ray.shutdown()


class RayEngine:
    """Tasks of the Ray that this process is connected to.

    Args:
        workers: Tasks at a time; as many as the cluster has cores for if None.
        needs: What each takes.

    Attributes:
        name: What it is called.
        workers: Tasks at a time.
    """

    name = "Ray"

    def __init__(self, workers: int | None = None, needs: Needs = ONE_CORE) -> None:
        ray = _ray()
        cores = int(ray.cluster_resources().get("CPU", 1))
        self.workers = workers or max(1, cores // needs.threads)
        self._needs = needs
        self._running: dict[Any, Task] = {}
        self._slots: dict[int, int] = {}
        self._begun: set[int] = set()
        self._mailbox = ray.remote(_Mailbox).options(num_cpus=0, max_restarts=-1).remote()

    def start(self, task: Task) -> None:
        """See `Engine.start`."""
        wanted = {
            "num_cpus": self._needs.threads,
            "max_retries": 0,
            "max_calls": _CALLS,
            "runtime_env": {"env_vars": {**self._variables(), **task.environment}},
        }
        if self._needs.memory:
            wanted["memory"] = int(1e6 * self._needs.memory)
        if self._needs.gpus:
            wanted["num_gpus"] = self._needs.gpus
        function = _ray().remote(**wanted)(_call_remotely)
        folder = os.getcwd()  # noqa: PTH109
        self._running[function.remote(self._mailbox, task, self._needs.threads, folder)] = task
        slots = set(range(1, self.workers + 1)) - set(self._slots.values())
        self._slots[task.number] = min(slots, default=0)

    def wait(self, seconds: float) -> list[Event]:
        """See `Engine.wait`."""
        ray = _ray()
        if not self._running:
            time.sleep(seconds)
            return []
        ready, rest = ray.wait(list(self._running), num_returns=1, timeout=seconds)
        if ready and rest:
            ready += ray.wait(rest, num_returns=len(rest), timeout=0)[0]
        events = self._letters()
        for one in ready:
            task = self._running.pop(one)
            value, fault = self._answer(one, task)
            if (
                task.number not in self._begun
            ):  # that it has begun is still on its way, or was lost with its worker
                events.append(Began(task.number, f"worker {self._slots[task.number]}"))
            self._begun.discard(task.number)
            events.append(Ended(task.number, value, fault))
            del self._slots[task.number]
        return events

    def share(self, file: Path) -> _InObjectStore:
        """See `Engine.share`; the file goes into Ray's object store."""
        return _InObjectStore(_ray().put(file.read_bytes()))

    def stop(self) -> None:
        """See `Engine.stop`."""
        ray, running = _ray(), list(self._running)
        for force in (False, True):
            for one in running:
                with suppress(Exception):  # it may have ended in this moment
                    ray.cancel(one, force=force)
            if running:
                with suppress(Exception):
                    running = ray.wait(running, num_returns=len(running), timeout=GRACE)[1]
        self._running.clear()
        self._slots.clear()
        self._begun.clear()

    def _variables(self) -> dict[str, str]:
        ours = {name: value for name, value in os.environ.items() if name.startswith(_VARIABLES)}
        return {**threads_in_words(self._needs.threads), **ours}

    def _letters(self) -> list[Event]:
        """Reports of tasks since the last call."""
        try:
            letters = _ray().get(self._mailbox.take.remote(), timeout=GRACE)
        except Exception:  # it died with its machine, and is made again: progress is lost, and nothing else
            return []
        events: list[Event] = []
        for number, machine, content in letters:
            if number not in self._slots:
                continue
            if machine:
                self._begun.add(number)
                events.append(Began(number, f"worker {self._slots[number]} ({machine})"))
            else:
                events.append(ProgressReport(number, content))
        return events

    def _answer(self, one: Any, task: Task) -> tuple[Any, Fault | None]:
        ray = _ray()
        try:
            value, fault = ray.get(one)
            return value, fault
        except ray.exceptions.RayError as error:
            lines = str(error).strip().splitlines() or [type(error).__name__]
            said = lines[0].partition(". ")[0].strip().rstrip(".")
            reason = f"Its worker or its machine was lost ({said}){last_words(task.log)}."
            return None, Fault(reason, crashed=True)


@dataclass(frozen=True)
class _InObjectStore:
    """A file in Ray's object store, which a machine fetches when one of its workers reads it first."""

    reference: Any

    def read(self) -> bytes:
        content: bytes = _ray().get(self.reference)
        return content


class _Mailbox:
    """Reports of tasks until they are collected."""

    def __init__(self) -> None:
        self._letters: list[tuple[int, str, Any]] = []

    def put(self, number: int, machine: str, content: Any) -> None:
        self._letters.append((number, machine, content))

    def take(self) -> list[tuple[int, str, Any]]:
        letters, self._letters = self._letters, []
        return letters


def _call_remotely(mailbox: Any, task: Task, threads: int, folder: str) -> tuple[Any, Fault | None]:
    """Run one task in a Ray worker, in the folder of the command if the machine has it."""
    ray = _ray()
    if Path(folder).is_dir():
        os.chdir(folder)
    mailbox.put.remote(task.number, ray.util.get_node_ip_address(), None)
    return call(task, lambda content: mailbox.put.remote(task.number, "", content), threads)


def _no_cluster(address: str, fault: str) -> InputError:
    return InputError(
        f"No Ray cluster responds at --address {address} ({' '.join(fault.split())[:200].rstrip('.')}); give auto on a "
        f"machine of the cluster, HOST:PORT, ray://HOST:PORT, or {THIS_MACHINE}."
    )


def _silence() -> None:
    """Ray prints what becomes of workers on the standard output, which is the command's; no setting forbids it."""
    with suppress(ImportError, AttributeError):
        from ray._private import worker

        worker.print_to_stdstream = lambda *given, **named: None


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Ray takes SIGTERM for itself, which is the command's."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@cache
def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise InputError(
            "--address needs Ray, which is not installed: pip install 'tracking3d[ray]'; without --address, "
            "the batch runs in processes of this machine."
        ) from error
    return ray


# Whether a Ray cluster responds: tried by a process of its own, since Ray itself waits for minutes and then aborts.
#
# What Ray prints meanwhile goes nowhere.

_CONNECT = """
import logging, os, sys
import ray
print("imported", flush=True)
try:
    ray.init(address=sys.argv[1], logging_level=logging.CRITICAL, log_to_driver=False)
except BaseException as error:
    print(" ".join(str(error).split())[:1000] or type(error).__name__, flush=True)
    os._exit(1)
ray.shutdown()
os._exit(0)
"""


def fault_of_cluster(address: str, seconds: float) -> str:
    """Why no cluster can be used at an address; empty if one can.

    Args:
        address: The cluster's address.
        seconds: How long it may take to respond; the time in which Ray is imported is not counted.
    """
    with subprocess.Popen(
        [sys.executable, "-c", _CONNECT, address],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        errors="replace",
    ) as process:
        assert process.stdout is not None
        try:
            process.stdout.readline()
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            return f"no response in {seconds:g} seconds"
        finally:
            process.kill()
        lines = process.stdout.read().strip().splitlines()
    if process.returncode == 0:
        return ""
    return lines[-1] if lines else "Ray ended while it connected"
