"""PyTorch3D solves the benchmark's problem, as far as that shows without it: its interface has a stand-in here."""

from __future__ import annotations

import importlib.util
import sys
from functools import partial

import pytest
import pytorch3d_stand_in
import torch
from scenes import bumpy_sphere

from tracking3d.rendering import SoftBand, render
from tracking3d.speed import pytorch3d
from tracking3d.speed.pytorch3d import ABSENT, render_pytorch3d, to_pytorch3d, why_no_pytorch3d
from tracking3d.speed.scene import RenderScene, RenderWorkload
from tracking3d.speed.table import format_left_out
from tracking3d.speed.timing import backends, left_out

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
def test_an_absent_pytorch3d_is_left_out():
    assert why_no_pytorch3d(CPU) == ABSENT
    assert "pytorch3d" not in backends(CPU)
    assert not left_out(CPU)


def test_an_installed_pytorch3d_takes_part(stand_in):
    assert "pytorch3d" in backends(CPU)
    assert not left_out(CPU)


def test_an_installation_that_cannot_draw_is_left_out_with_the_reason(stand_in, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("not compiled with GPU support\nand more")

    monkeypatch.setattr(sys.modules["pytorch3d.renderer.mesh"], "rasterize_meshes", broken)
    assert "pytorch3d" not in backends(CPU)
    why = "it is installed but cannot render here (RuntimeError: not compiled with GPU support)"
    assert left_out(CPU) == {"pytorch3d": why}
    assert format_left_out({"left_out": left_out(CPU)}) == [f"pytorch3d takes no part: {why}."]


@pytest.mark.parametrize("part", ["pytorch3d.ops", "pytorch3d.renderer.mesh", "pytorch3d.structures"])
def test_an_installation_without_a_part_is_broken_and_not_absent(stand_in, monkeypatch, part):
    monkeypatch.setitem(sys.modules, part, None)  # its import then fails
    assert "pytorch3d" not in backends(CPU)
    assert f"import of {part} halted" in left_out(CPU)["pytorch3d"]


@pytest.mark.slow
@torch.no_grad()
def test_covered_pixels_stay_covered_only_with_enough_faces(stand_in, monkeypatch):
    scene = RenderScene.make(RenderWorkload(size=24, frames=1, texture=24, frequency=14), CPU)
    arguments = {**scene.parameters, **scene.constants}
    covered = render(**arguments).face_index >= 0
    assert ((render_pytorch3d(**arguments).face_index >= 0) == covered).all()
    monkeypatch.setattr(pytorch3d, "FACES_PER_PIXEL", 10)
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
