"""The choice of an engine from the user's options."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tracking3d.engines.processes import ProcessEngine
from tracking3d.engines.protocol import ONE_CORE, Engine, Needs


@contextmanager
def open_engine(
    address: str | None = None, workers: int | None = None, needs: Needs = ONE_CORE
) -> Iterator[Engine]:
    """Ray if an address is given, else processes of this machine; running tasks are stopped at the end.

    Args:
        address: Address of a Ray cluster, see `tracking3d.engines.on_ray.open_ray`.
        workers: Tasks at a time; as many as there are cores for if None.
        needs: What each takes.

    Raises:
        InputError: If Ray is asked for and not installed, or no cluster responds there.
    """
    if address is None:
        yield ProcessEngine(workers, needs)
        return
    from tracking3d.engines.on_ray import open_ray

    with open_ray(address, workers, needs) as engine:
        yield engine
