"""Kernels on several threads: the answers of one thread, whatever their number."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator

import pytest
import torch
from implementations import NUMBA
from scenes import bumpy_sphere
from torch import Tensor

from tracking3d.rendering import SoftBand, channels_last, render, texture_losses
from tracking3d.rendering.kernels.compilation import get_num_threads, set_num_threads

SCENE = bumpy_sphere((40, 44), views=7, frequency=6)


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    before = get_num_threads()
    yield
    set_num_threads(before)


def rendered(band: SoftBand | None = None) -> list[Tensor]:
    """All that a rendering gives, and all its gradients."""
    arguments = SCENE.arguments(NUMBA.dtype)
    result = render(faces=SCENE.faces, size=SCENE.size, band=band, backend="numba", **arguments)
    (result.silhouette.square().sum() + result.features.square().sum()).backward()
    parts = result.face_index, result.depth, result.pixels, result.silhouette, result.uv
    return [part.detach() for part in parts] + [leaf.grad for leaf in arguments.values()]


def compared(channels: int, places: int, side: int) -> tuple[list[Tensor], Tensor]:
    """Losses of a texture and the gradient by the places; the gradient by the texture."""
    generator = torch.Generator().manual_seed(channels)
    texture = channels_last(torch.rand(channels, side, side, generator=generator)).requires_grad_()
    uv = torch.rand(places, 2, generator=generator).requires_grad_()
    observed = channels_last(torch.rand(2, channels, 50, 60, generator=generator))
    pixels = torch.randint(6000, (places,), generator=generator)
    loss, variation = texture_losses(texture, uv, observed, pixels, 0.25, backend="numba")
    (loss.sum() + variation).backward()
    return [loss.detach(), variation.detach(), uv.grad], texture.grad


def test_one_thread_is_what_kernels_use_unless_told_otherwise():
    assert get_num_threads() == 1


@pytest.mark.parametrize("threads", [2, 3, 5, 16])
@pytest.mark.parametrize("band", [SoftBand(), SoftBand(70.0, 0.2, 4)], ids=["DIB-R", "capped"])
def test_a_rendering_is_the_same_bits_on_any_number_of_threads(band, threads):
    expected = rendered(band)
    set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(rendered(band), expected, strict=True))


@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize(
    ("channels", "places", "side"), [(64, 20_000, 200), (3, 300_000, 97), (5, 9000, 9)], ids=str
)
def test_texture_losses_are_the_same_bits_and_the_texture_s_gradient_is_close(
    channels, places, side, threads
):
    expected, expected_gradient = compared(channels, places, side)
    set_num_threads(threads)
    results, gradient = compared(channels, places, side)
    assert all(torch.equal(a, b) for a, b in zip(results, expected, strict=True))
    assert torch.linalg.norm(gradient - expected_gradient) < 1e-5 * torch.linalg.norm(expected_gradient)
    again, same = compared(channels, places, side)
    assert all(torch.equal(a, b) for a, b in zip(again, results, strict=True))
    assert torch.equal(same, gradient)


@pytest.mark.parametrize("threads", [0, -1])
def test_no_thread_at_all_is_refused(threads):
    set_num_threads(2)
    with pytest.raises(ValueError, match=rf"threads is {threads}; give one or more"):
        set_num_threads(threads)
    assert get_num_threads() == 2


def test_threads_of_the_caller_may_render_at_the_same_time():
    expected = rendered()
    set_num_threads(2)
    answers: list[list[Tensor]] = []
    callers = [threading.Thread(target=lambda: answers.append(rendered())) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(answers) == 4
    for answer in answers:
        assert all(torch.equal(a, b) for a, b in zip(answer, expected, strict=True))


def test_a_fault_on_another_thread_is_raised_to_the_caller():
    set_num_threads(3)
    with pytest.raises(IndexError):
        texture_losses(
            torch.rand(3, 8, 8),
            torch.rand(30_000, 2),
            torch.rand(1, 3, 4, 4),
            torch.full((30_000,), 16),
            0.25,
            backend="numba",
        )
    assert rendered()[0].shape == (7, 40, 44)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_renders_with_threads_of_its_own():
    set_num_threads(3)
    expected = rendered()  # the pool of threads exists
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    child = context.Process(target=lambda: answers.put([part.numpy() for part in rendered()]))
    child.start()
    answer = answers.get(timeout=60)
    child.join(60)
    assert child.exitcode == 0
    assert all((a == b.numpy()).all() for a, b in zip(answer, expected, strict=True))
