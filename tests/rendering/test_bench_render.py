"""The benchmark compares like with like: the dense implementation draws the same picture."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from scenes import Textured, bumpy_sphere

from tracking3d.errors import InputError
from tracking3d.evaluation.bench_dense import render_dense
from tracking3d.evaluation.bench_render import BACKENDS, Scene, benchmark
from tracking3d.rendering import SoftBand, render

SCENES = {
    "closed mesh": (bumpy_sphere((24, 30), frequency=3), SoftBand()),
    "wide band": (bumpy_sphere((24, 24), frequency=3), SoftBand(100.0, 0.2, 1000)),
    "few faces count": (bumpy_sphere((24, 24), frequency=3), SoftBand(100.0, 0.2, 4)),
    "partly outside": (
        replace(
            bumpy_sphere((24, 24), frequency=3), t=torch.tensor([[1.2, 0.5, 3.0], [-0.9, 0, 3]]).double()
        ),
        SoftBand(100.0, 0.2),
    ),
    "partly behind": (
        replace(
            bumpy_sphere((24, 24), frequency=3), t=torch.tensor([[0.0, 0.4, 0.3], [-0.9, 0, 3]]).double()
        ),
        SoftBand(),
    ),
}


@pytest.mark.parametrize(("scene", "band"), SCENES.values(), ids=SCENES)
def test_the_dense_picture_and_its_gradients_are_the_renderers(scene: Textured, band: SoftBand):
    results = []
    for backend in (render, render_dense):
        arguments = scene.arguments()
        drawn = backend(faces=scene.faces, size=scene.size, band=band, **arguments)
        weights = torch.linspace(0, 1, drawn.silhouette.numel(), dtype=torch.float64)
        loss = (drawn.silhouette.flatten() * weights).sum() + (
            drawn.image().square().sum(1).flatten() * weights
        ).sum()
        loss.backward()
        results.append((drawn, {name: value.grad for name, value in arguments.items()}))
    (drawn, gradients), (dense, dense_gradients) = results
    assert torch.equal(drawn.face_index, dense.face_index)
    assert torch.equal(drawn.pixels, dense.pixels)
    for name in ("depth", "silhouette", "uv", "features"):
        torch.testing.assert_close(getattr(drawn, name), getattr(dense, name), rtol=1e-6, atol=1e-6)
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, dense_gradients[name], rtol=1e-4, atol=1e-5, msg=name)


def test_chunks_make_no_difference(monkeypatch):
    scene = bumpy_sphere((20, 20), frequency=3)
    whole = render_dense(faces=scene.faces, size=scene.size, **scene.arguments())
    monkeypatch.setattr("tracking3d.evaluation.bench_dense.CHUNK", 7 * len(scene.faces))
    chunked = render_dense(faces=scene.faces, size=scene.size, **scene.arguments())
    assert torch.equal(whole.image(), chunked.image())
    assert torch.equal(whole.silhouette, chunked.silhouette)


def test_all_backends_are_timed_on_the_same_loss():
    scene = Scene.make(20, 2, 3, torch.device("cpu"))
    expected = scene.loss(render_dense).item()
    assert scene.mask.mean() > 0
    for backend in BACKENDS.values():
        assert scene.loss(backend).item() == pytest.approx(expected, rel=1e-4)


def test_the_report_states_the_problem_and_compares_every_backend_with_the_dense_one():
    threads = torch.get_num_threads()
    report = benchmark(size=16, frames=2, channels=1, repeats=1)
    assert torch.get_num_threads() == threads
    assert json.loads(json.dumps(report)) == report
    assert (report["size"], report["frames"], report["channels"]) == (16, 2, 1)
    assert report["faces"] == 2420 and report["texture"] == 300
    assert report["threads"] == 1
    assert set(report["backends"]) == {*BACKENDS, "dense"}
    for times in report["backends"].values():
        assert times["forward_ms"] > 0 and times["backward_ms"] > 0 and times["measurements"] == 1
        assert times["total_ms"] == pytest.approx(times["forward_ms"] + times["backward_ms"], abs=0.02)
    assert report["speedup_over_dense"] > 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_a_device_that_is_not_there_is_refused_in_one_sentence():
    with pytest.raises(InputError, match=r"cuda.*not available"):
        benchmark(size=16, frames=1, channels=1, repeats=1, device="cuda")
