"""A network that never ends is stopped by the user, and by itself after a while."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.features.networks import session
from tracking3d.features.networks.session import Network

onnx = pytest.importorskip("onnx")
node, value = onnx.helper.make_node, onnx.helper.make_tensor_value_info
FLOAT, BOOL, INT64 = (getattr(onnx.TensorProto, name) for name in ("FLOAT", "BOOL", "INT64"))
FEEDS = {"image": np.ones((1, 3), np.float32)}


@pytest.fixture
def endless(tmp_path: Path) -> Network:
    """A loop whose condition stays true."""
    body = onnx.helper.make_graph(
        [node("Identity", ["going"], ["goes_on"]), node("Abs", ["before"], ["after"])],
        "body",
        [value("turn", INT64, []), value("going", BOOL, []), value("before", FLOAT, [1, 3])],
        [value("goes_on", BOOL, []), value("after", FLOAT, [1, 3])],
    )
    graph = onnx.helper.make_graph(
        [node("Loop", ["", "true", "image"], ["last"], body=body)],
        "endless",
        [value("image", FLOAT, [1, 3])],
        [value("last", FLOAT, [1, 3])],
        [onnx.numpy_helper.from_array(np.array(True), "true")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "endless.onnx")
    return Network(tmp_path / "endless.onnx")


def test_ctrl_c_ends_a_network_that_never_does(endless):
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        endless.run(FEEDS)
    assert all(not thread.daemon for thread in threading.enumerate() if "run" in thread.name)


def test_a_run_that_takes_too_long_is_ended_with_one_sentence(endless, monkeypatch):
    monkeypatch.setattr(session, "LONGEST_RUN", 0.3)
    with pytest.raises(InputError, match=r"endless\.onnx did not end within 0\.3 s; give another network"):
        endless.run(FEEDS)
