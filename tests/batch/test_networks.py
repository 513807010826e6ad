"""Networks of the catalogue reach machines that lack them, and others are left as they are."""

from __future__ import annotations

from dataclasses import dataclass

from tracking3d.batch.video_job import VideoJob, keep_networks, share_networks
from tracking3d.config.models import PipelineConfig
from tracking3d.engines.choosing import InThisProcess
from tracking3d.features.networks.catalogue import known_networks
from tracking3d.features.networks.store import VARIABLE, network_path


@dataclass(frozen=True)
class Content:
    content: bytes

    def read(self) -> bytes:
        return self.content


class Elsewhere(InThisProcess):
    """An engine whose workers see other files."""

    def share(self, file):
        return Content(file.read_bytes())


def test_a_network_that_is_named_is_there_afterwards(tmp_path, monkeypatch):
    name = next(iter(known_networks()))
    features = {"name": "onnx", "model": name}
    jobs = [VideoJob(n, n, PipelineConfig.model_validate({"features": features})) for n in ("a", "b")]
    monkeypatch.setenv(VARIABLE, str(tmp_path / "here"))
    assert share_networks(Elsewhere(), jobs) == ()  # nobody has it: the plug-in will say so
    path = network_path(known_networks()[name])
    path.parent.mkdir(parents=True)
    path.write_bytes(b"a network")
    assert share_networks(InThisProcess(), jobs) == ()
    shared = share_networks(Elsewhere(), jobs)
    assert [one.name for one in shared] == [name]

    monkeypatch.setenv(VARIABLE, str(tmp_path / "there"))
    keep_networks(shared)
    there = network_path(known_networks()[name])
    assert there != path and there.read_bytes() == b"a network"
    there.write_bytes(b"its own")
    keep_networks(shared)
    assert there.read_bytes() == b"its own"
