"""Jobs side by side in processes of this machine, each telling how far it is."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import get_context
from queue import Empty
from typing import Any, TypeVar

from tracking3d.errors import Tracking3dError

Job = TypeVar("Job")
Result = TypeVar("Result")
Tell = Callable[[Any], None]
"""Takes whatever can be pickled to who waits for the job."""

_LOOK = 0.2  # seconds
_queue: Any = None


def side_by_side(
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
    context = get_context("spawn")
    queue = context.Queue()
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = (
        before or "1"
    )  # processes that share a machine must not each take all of it
    pool = ProcessPoolExecutor(
        min(workers, len(jobs)), mp_context=context, initializer=_begin, initargs=(queue,)
    )
    try:
        futures = [pool.submit(_run, function, job) for job in jobs]
        _follow(futures, queue, told)
        return [future.result() for future in futures]
    except BrokenProcessPool as error:
        raise Tracking3dError(
            "A process that tracked a part of the video ended without a word, as where memory runs out; the same "
            "command with --resume goes on."
        ) from error
    except BaseException:
        for process in list(
            (pool._processes or {}).values()
        ):  # a pool has no word for this before Python 3.14
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        if before is None:
            os.environ.pop("OMP_NUM_THREADS", None)


class _Ended:
    """The last that a job tells. A process hands its words on in a thread of its own, after the job has returned."""


def _follow(futures: Sequence[Future[Any]], queue: Any, told: Callable[[Any], None]) -> None:
    """Pass on what is told until all is done and told, or something fails."""
    waiting, telling = set(futures), len(futures)
    while waiting or telling:
        done, waiting = wait(waiting, timeout=_LOOK, return_when=FIRST_COMPLETED)
        with suppress(Empty):
            while telling:
                content = queue.get(timeout=0 if waiting else _LOOK)
                if isinstance(content, _Ended):
                    telling -= 1
                else:
                    told(content)
        for future in done:
            future.result()


def _begin(queue: Any) -> None:
    global _queue
    _queue = queue
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def _run(function: Callable[[Tell, Job], Result], job: Job) -> Result:
    try:
        return function(_queue.put, job)
    finally:
        _queue.put(_Ended())
