"""Distribution of networks to workers: each is sent to a machine once, whatever the number of videos."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from tracking3d.batch.video_job import VideoJob
from tracking3d.config.models import AUTO
from tracking3d.engines.protocol import Engine, Shared
from tracking3d.networks.catalogue import known_networks
from tracking3d.networks.store import find_known, network_path
from tracking3d.pipeline.tracker_selection import CANDIDATES
from tracking3d.results.files import write_atomic, writing


@dataclass(frozen=True)
class SharedNetwork:
    """A network of the catalogue that a machine may lack."""

    name: str  # its name there
    content: Shared  # its file


def share_networks(engine: Engine, jobs: Iterable[VideoJob]) -> tuple[SharedNetwork, ...]:
    """Share the networks that the jobs name through the engine, if its workers may be on other machines.

    The mask tracker ``auto`` names all that it may choose from, so that it chooses there as it would here.
    Networks that are given by the path of a file are not sent: every machine must have them there.
    """
    known, jobs = known_networks(), list(jobs)
    named = {
        value
        for job in jobs
        for plugin in (job.config.tracker, job.config.features)
        for value in plugin.model_dump().values()
        if isinstance(value, str) and value in known
    }
    if any(job.config.tracker.name == AUTO for job in jobs):
        named |= {network for candidate in CANDIDATES for network in candidate.networks}
    shared = []
    for name in sorted(named):
        path = network_path(known[name])
        if path.is_file() and (content := engine.share(path)) is not None:
            shared.append(SharedNetwork(name, content))
    return tuple(shared)


def keep_networks(networks: Iterable[SharedNetwork]) -> None:
    """Put the networks that this machine lacks into its cache, in which the plug-ins look for them.

    Raises:
        OutputError: If the cache cannot be written.
    """
    for network in networks:
        path = network_path(find_known(network.name))
        if not path.is_file():
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, network.content.read())
