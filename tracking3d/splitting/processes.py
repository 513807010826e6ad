"""Jobs side by side in processes of this machine, each telling how far it is: by the engine that batches have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from tracking3d.engines.mapping import map_tasks
from tracking3d.engines.processes import ProcessEngine
from tracking3d.engines.protocol import Ended, Event, Task, Told
from tracking3d.errors import Tracking3dError

Job = TypeVar("Job")
Result = TypeVar("Result")
Tell = Callable[[Any], None]
"""Takes whatever can be pickled to who waits for the job."""


def run_in_processes(
    function: Callable[[Tell, Job], Result],
    jobs: Sequence[Job],
    workers: int,
    told: Callable[[Any], None] = lambda content: None,
) -> list[Result]:
    """What a function of a module makes of each job, in the order of the jobs.

    One worker is this process. Ctrl-C and a failure stop the others; what they had finished is theirs to keep.

    Args:
        function: Called as ``function(tell, job)``.
        jobs: What can be pickled.
        workers: Processes at a time.
        told: Is given what the functions tell, in this process.

    Raises:
        Tracking3dError: The first that a job raised, or that its process crashed.
    """
    if workers <= 1 or len(jobs) <= 1:
        return [function(told, job) for job in jobs]

    def listener(event: Event) -> None:
        if isinstance(event, Told):
            told(event.content)
        elif isinstance(event, Ended):
            _raise(event)

    tasks = [Task(number, _called, (function, job)) for number, job in enumerate(jobs)]
    ended = map_tasks(ProcessEngine(min(workers, len(jobs))), tasks, listener=listener)
    return [ended[number].value for number in range(len(jobs))]


@dataclass(frozen=True)
class _Raised:
    """An error in a sentence, as the answer of a process: engines tell of errors by their words only."""

    error: Tracking3dError


def _called(tell: Tell, function: Callable[[Tell, Any], Any], job: Any) -> Any:
    try:
        return function(tell, job)
    except Tracking3dError as error:
        return _Raised(error)


def _raise(event: Ended) -> None:
    if isinstance(event.value, _Raised):
        raise event.value.error
    if event.fault is None:
        return
    if event.fault.crashed:
        raise Tracking3dError(
            "A process that tracked a part of the video ended without a word, as where memory runs out "
            f"({event.fault.reason.rstrip('.')}); the same command with --resume goes on."
        )
    raise Tracking3dError(f"A part of the video came to nothing: {event.fault.reason}")
