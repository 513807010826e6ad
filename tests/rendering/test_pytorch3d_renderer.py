"""PyTorch3D solves the benchmark's problem, as far as that shows without it: its interface has a stand-in here."""

from __future__ import annotations

import importlib.util
import json
import sys
from functools import partial

import pytest
import pytorch3d_stand_in
import torch
from scenes import bumpy_sphere
from typer.testing import CliRunner

import pytorch3d_renderer
from pytorch3d_renderer import ABSENT, render_pytorch3d, to_pytorch3d, why_no_pytorch3d
from render import render as render_script
from script import as_program
from tracking3d.rendering import SoftBand, render
from tracking3d_bench.speed import benchmark as bench_render
from tracking3d_bench.speed.scene import RenderScene, RenderWorkload
from tracking3d_bench.speed.timing import time_backends

CPU = torch.device("cpu")
BAND = SoftBand(sigma=7000.0, boxlen=0.06)
"""One that ends where it has faded away, so that it makes no difference whether its end is a box or a distance."""


@pytest.fixture
def stand_in(monkeypatch) -> None:
    pytorch3d_stand_in.install(monkeypatch)


@pytest.mark.parametrize(
    ("pixel", "size", "expected"),
    [
        ((0, 0), (4, 4), (0.75, 0.75)),  # the centre of the top-left pixel; x points left, y up
        ((3, 0), (4, 4), (-0.75, 0.75)),
        ((3, 3), (4, 4), (-0.75, -0.75)),
        ((1.5, 1.5), (4, 4), (0.0, 0.0)),
        ((-0.5, 3.5), (4, 4), (1.0, -1.0)),  # the window's corner
        ((-0.5, -0.5), (2, 4), (2.0, 1.0)),  # the longer side goes on at the same scale
        ((-0.5, -0.5), (4, 2), (1.0, 2.0)),
    ],
)
def test_pixels_lie_where_pytorch3d_expects_them(pixel, size, expected):
    assert to_pytorch3d(torch.tensor(pixel), size).tolist() == pytest.approx(expected)


@pytest.mark.skipif(importlib.util.find_spec("pytorch3d") is not None, reason="PyTorch3D is installed")
def test_an_absent_pytorch3d_is_refused_in_a_sentence():
    assert why_no_pytorch3d(CPU) == ABSENT
    result = CliRunner().invoke(as_program(render_script), [])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: PyTorch3D cannot be timed: {ABSENT}")


def test_an_installed_pytorch3d_is_timed_beside_the_backends(stand_in):
    assert why_no_pytorch3d(CPU) == ""
    problem, others = (
        RenderWorkload(size=16, frames=1, texture=16, frequency=2),
        {"pytorch3d": render_pytorch3d},
    )
    times = time_backends(problem, CPU, repeats=1, threads=1, others=others)
    assert {"torch", "numba", "pytorch3d"} == set(times)
    assert all(len(measured) == 1 for measured in times.values())


def test_the_script_prints_its_times_without_the_dense_implementation(stand_in, monkeypatch):
    asked = {}

    def benchmark(*given, **named):
        asked.update(named, given=given)
        return {"backends": {}}

    monkeypatch.setattr(bench_render, "benchmark", benchmark)
    result = CliRunner().invoke(as_program(render_script), ["--size", "32", "--frames", "2", "--json"])
    assert json.loads(result.stdout) == {"backends": {}}
    assert (asked["given"], asked["dense"]) == ((32, 2, 3), False)
    assert asked["others"] == {"pytorch3d": render_pytorch3d}


def test_an_installation_that_cannot_draw_says_why(stand_in, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("not compiled with GPU support\nand more")

    monkeypatch.setattr(sys.modules["pytorch3d.renderer.mesh"], "rasterize_meshes", broken)
    why = "it is installed but cannot render here (RuntimeError: not compiled with GPU support)"
    assert why_no_pytorch3d(CPU) == why


@pytest.mark.parametrize("part", ["pytorch3d.ops", "pytorch3d.renderer.mesh", "pytorch3d.structures"])
def test_an_installation_without_a_part_is_broken_and_not_absent(stand_in, monkeypatch, part):
    monkeypatch.setitem(sys.modules, part, None)  # its import then fails
    assert f"import of {part} halted" in why_no_pytorch3d(CPU)


@pytest.mark.slow
@torch.no_grad()
def test_covered_pixels_stay_covered_only_with_enough_faces(stand_in, monkeypatch):
    scene = RenderScene.make(RenderWorkload(size=24, frames=1, texture=24, frequency=14), CPU)
    arguments = {**scene.parameters, **scene.constants}
    covered = render(**arguments).face_index >= 0
    assert ((render_pytorch3d(**arguments).face_index >= 0) == covered).all()
    monkeypatch.setattr(pytorch3d_renderer, "FACES_PER_PIXEL", 10)
    assert (covered & (render_pytorch3d(**arguments).face_index < 0)).any()


def test_pytorch3d_draws_the_same_picture(stand_in):
    scene = bumpy_sphere((24, 24), frequency=3)
    arguments = {**scene.arguments(torch.float32), "faces": scene.faces, "size": scene.size}
    drawn, expected = render_pytorch3d(**arguments, band=BAND), render(**arguments, band=BAND)
    assert torch.equal(drawn.face_index, expected.face_index)
    assert torch.equal(drawn.pixels, expected.pixels)
    torch.testing.assert_close(drawn.uv, expected.uv, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(drawn.depth, expected.depth, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(drawn.silhouette, expected.silhouette, rtol=0, atol=1e-4)


def test_pytorch3d_is_timed_on_the_same_loss_and_gradients(stand_in):
    scene = RenderScene.make(RenderWorkload(size=24, frames=2, texture=24, frequency=3), CPU)
    answers = []
    for backend in (render, render_pytorch3d):
        scene.forget_gradients()
        loss = scene.loss(partial(backend, band=BAND))
        loss.backward()
        answers.append((loss.item(), {name: value.grad for name, value in scene.parameters.items()}))
    (expected, gradients), (loss, of_pytorch3d) = answers
    assert loss == pytest.approx(expected, rel=1e-4)
    for name, gradient in gradients.items():
        assert (of_pytorch3d[name] - gradient).norm() < 0.01 * gradient.norm(), name
