"""The benchmark compares like with like: all backends solve one problem, and the dense one draws the same picture."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from scenes import Textured, bumpy_sphere

from tracking3d.errors import InputError
from tracking3d.rendering import SoftBand, render
from tracking3d.rendering.kernels import compilation as kernels
from tracking3d_bench.speed import benchmark as bench_render
from tracking3d_bench.speed import timing as bench_timing
from tracking3d_bench.speed.benchmark import benchmark
from tracking3d_bench.speed.dense import render_dense
from tracking3d_bench.speed.scene import RenderScene, RenderWorkload, default_texture
from tracking3d_bench.speed.timing import backends, time_backends

CPU = torch.device("cpu")
SMALL = RenderWorkload(size=20, frames=2, channels=3, texture=24, frequency=3)
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
    monkeypatch.setattr("tracking3d_bench.speed.dense.CHUNK", 7 * len(scene.faces))
    chunked = render_dense(faces=scene.faces, size=scene.size, **scene.arguments())
    assert torch.equal(whole.image(), chunked.image())
    assert torch.equal(whole.silhouette, chunked.silhouette)


@pytest.fixture
def quick(monkeypatch) -> None:
    """Memory needs processes of its own; it has its own tests."""
    monkeypatch.setattr(bench_render, "peak_memory", lambda name, problem, device, threads: 12.34)


def test_torch_and_numba_take_part_on_the_cpu():
    assert {"torch", "numba"} <= set(backends(CPU))


def test_without_numba_torch_is_measured_alone(monkeypatch):
    monkeypatch.setattr(bench_timing, "why_no_numba", lambda: "numba cannot be imported")
    assert "numba" not in backends(CPU)
    assert "numba" not in time_backends(SMALL, CPU, repeats=1, threads=1)


def test_the_kernels_take_no_part_on_a_gpu():
    assert "numba" not in backends(torch.device("cuda"))


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_all_backends_are_timed_on_the_same_loss_and_gradients(name):
    scene, answers = RenderScene.make(SMALL, CPU), []
    assert scene.mask.mean() > 0
    for backend in (render_dense, backends(CPU)[name]):
        scene.forget_gradients()
        loss = scene.loss(backend)
        loss.backward()
        answers.append((loss.item(), {key: value.grad for key, value in scene.parameters.items()}))
    (expected, gradients), (loss, found) = answers
    assert loss == pytest.approx(expected, rel=1e-4)
    for key, gradient in gradients.items():
        assert gradient.norm() > 0
        assert (found[key] - gradient).norm() < 1e-3 * gradient.norm(), key


def test_each_backend_is_rendered_by_what_its_name_says():
    scene = RenderScene.make(SMALL, CPU)
    for name in ("torch", "numba"):
        assert backends(CPU)[name](**scene.parameters, **scene.constants).backend == name


def test_backends_take_turns_whose_first_iterations_do_not_count(monkeypatch):
    turns = []

    def noted(name):
        def draw(**arguments):
            turns.append(name)
            return render(**arguments)

        return draw

    monkeypatch.setattr(
        bench_timing, "backends", lambda device: {name: noted(name) for name in ("torch", "numba")}
    )
    monkeypatch.setattr(bench_timing, "render_dense", noted("dense"))
    times = time_backends(SMALL, CPU, repeats=5, threads=1, dense=True)
    first, second = ["torch"] * 4 + ["numba"] * 4, ["torch"] * 3 + ["numba"] * 3
    assert turns == [*first, *second, "dense"]
    assert {name: len(measured) for name, measured in times.items()} == {"torch": 5, "numba": 5, "dense": 1}


def test_threads_are_given_as_a_run_does_and_taken_back_afterwards(monkeypatch):
    seen = {}

    def look(name):
        def draw(**arguments):
            seen[name] = (torch.get_num_threads(), kernels.get_num_threads())
            return render(**arguments)

        return draw

    monkeypatch.setattr(
        bench_timing, "backends", lambda device: {name: look(name) for name in ("torch", "numba")}
    )
    before = torch.get_num_threads(), kernels.get_num_threads()
    time_backends(SMALL, CPU, repeats=1, threads=2)
    assert seen["torch"][0] == 2
    assert seen["numba"] == (1, 2)
    assert (torch.get_num_threads(), kernels.get_num_threads()) == before


def test_the_report_states_the_problem_and_compares_the_backends(quick):
    report = benchmark(size=16, frames=2, channels=1, repeats=1)
    assert json.loads(json.dumps(report)) == report
    assert (report["size"], report["frames"], report["channels"]) == (16, 2, 1)
    assert (report["faces"], report["texture"]) == (2420, 300)
    assert (report["threads"], report["device"]) == (1, "cpu")
    assert report["machine"].keys() == {"cpu", "cores", "torch", "numba"}
    assert report["machine"]["cpu"] and report["machine"]["cores"] >= 1
    assert {"torch", "numba", "dense"} <= set(report["backends"])
    dense, twin = report["backends"]["dense"], report["backends"]["torch"]
    for times in report["backends"].values():
        assert times["forward_ms"] > 0 and times["backward_ms"] > 0 and times["measurements"] == 1
        assert times["total_ms"] == pytest.approx(times["forward_ms"] + times["backward_ms"], abs=0.02)
        assert times["ratio_to_torch"] == pytest.approx(times["total_ms"] / twin["total_ms"], rel=0.01)
        assert times["speedup_over_dense"] == pytest.approx(dense["total_ms"] / times["total_ms"], rel=0.01)
    assert report["speedup_over_dense"] == twin["speedup_over_dense"]
    assert twin["peak_memory_mb"] == 12.3 and dense["peak_memory_mb"] is None
    assert twin["measured_frames"] == 2 and dense["measured_frames"] == 1


def test_the_dense_one_can_be_left_out(quick):
    report = benchmark(size=16, frames=1, channels=1, texture=8, repeats=1, dense=False)
    assert "dense" not in report["backends"]
    assert report["speedup_over_dense"] is None
    assert report["texture"] == 8


def test_the_texture_is_as_large_as_solvers_make_it():
    assert [default_texture(channels) for channels in (3, 16, 17, 128)] == [300, 300, 150, 150]


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_a_device_that_is_not_there_is_refused_in_one_sentence():
    with pytest.raises(InputError, match=r"cuda.*not available"):
        benchmark(device="cuda")


@pytest.mark.parametrize("name", ["tpu9", "meta", ""])
def test_a_device_that_is_none_is_refused_in_one_sentence(name):
    with pytest.raises(InputError, match="choose cpu, cuda or cuda:N"):
        benchmark(device=name)
