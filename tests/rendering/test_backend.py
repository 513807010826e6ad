"""Which implementation renders, and how a run says so."""

from __future__ import annotations

import builtins
import sys
from collections.abc import Callable, Iterator

import pytest
import torch
from scenes import bumpy_sphere, triangles
from torch import Tensor

from tracking3d.config.models import RuntimeConfig
from tracking3d.errors import InputError
from tracking3d.pipeline import components
from tracking3d.rendering import (
    back_project,
    backend,
    interpolate,
    prepare_backend,
    rasterize,
    render,
    soft_silhouette,
    texture_losses,
)
from tracking3d.rendering.backend import use_numba, why_no_numba
from tracking3d.rendering.backprojection import TexelMap
from tracking3d.rendering.kernels import compilation

LOW, HIGH = torch.zeros(1), torch.zeros(1, dtype=torch.float64)


@pytest.fixture(autouse=True)
def settings_restored() -> Iterator[None]:
    before = torch.get_num_threads(), compilation.get_num_threads()
    yield
    torch.set_num_threads(before[0])
    compilation.set_num_threads(before[1])


@pytest.fixture
def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "why_no_numba", lambda: "numba cannot be imported (ImportError: gone)")


@pytest.fixture
def kernels_called(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the kernels that ran."""
    from tracking3d.rendering.kernels.compilation import Kernel

    names: list[str] = []
    call = Kernel.__call__

    def recorded(self: Kernel, *arguments: object) -> object:
        names.append(self.__name__)
        return call(self, *arguments)

    monkeypatch.setattr(Kernel, "__call__", recorded)
    return names


def calls(dtype: torch.dtype, name: str) -> dict[str, Callable[[], object]]:
    """Everything that has a backend to choose, by name."""
    scene = triangles(1, faces=6)
    screen, depth = scene.screen.to(dtype), scene.depth.to(dtype)
    index = torch.zeros(2, *scene.size, dtype=torch.long)
    places = torch.zeros(5, dtype=torch.long)
    image = torch.rand(2, 3, 4, 4, dtype=dtype)
    mesh = bumpy_sphere((20, 20), views=1, frequency=2)
    arguments = mesh.arguments(dtype)
    vertices, R, t, K = (arguments[key].detach() for key in ("vertices", "R", "t", "K"))
    texels = TexelMap.of(mesh.face_uvs.to(dtype), 8)
    seen, valid = torch.rand(3, 20, 20, dtype=dtype), torch.ones(20, 20, dtype=dtype)
    return {
        "rasterize": lambda: rasterize(screen, depth, scene.faces, scene.size, name),
        "soft_silhouette": lambda: soft_silhouette(screen, depth, scene.faces, index, backend=name),
        "interpolate": lambda: interpolate(
            screen, depth, scene.faces, torch.rand(6, 3, 2, dtype=dtype), index, name
        ),
        "texture_losses": lambda: texture_losses(
            image[0], torch.rand(5, 2, dtype=dtype), image, places, 0.5, backend=name
        ),
        "render": lambda: render(faces=mesh.faces, size=(20, 20), backend=name, **arguments),
        "back_project": lambda: back_project(
            seen, valid, vertices, mesh.faces, texels, R[0], t[0], K[0], name
        ),
    }


OPERATIONS = ["rasterize", "soft_silhouette", "interpolate", "texture_losses", "render", "back_project"]


@pytest.mark.parametrize("operation", OPERATIONS)
def test_auto_takes_the_kernels_for_float32_on_the_cpu(operation, kernels_called):
    call = calls(torch.float32, "auto")[operation]
    kernels_called.clear()
    call()
    assert kernels_called


@pytest.mark.parametrize("operation", OPERATIONS)
def test_auto_takes_torch_for_float64(operation, kernels_called):
    calls(torch.float64, "auto")[operation]()
    assert not kernels_called


@pytest.mark.parametrize("operation", OPERATIONS)
def test_torch_is_taken_where_it_is_asked_for(operation, kernels_called):
    call = calls(torch.float32, "torch")[operation]
    kernels_called.clear()
    call()
    assert not kernels_called


@pytest.mark.parametrize("operation", OPERATIONS)
def test_without_numba_auto_falls_back_to_torch(operation, kernels_called, without_numba):
    calls(torch.float32, "auto")[operation]()
    assert not kernels_called


@pytest.mark.parametrize("operation", OPERATIONS)
def test_the_kernels_are_refused_for_float64_in_a_sentence_that_names_it(operation):
    said = (
        r"^the backend 'numba' renders torch.float32 on cpu, not torch.float64 on cpu; choose auto or torch$"
    )
    with pytest.raises(ValueError, match=said):
        calls(torch.float64, "numba")[operation]()


@pytest.mark.parametrize("operation", OPERATIONS)
def test_without_numba_the_kernels_are_refused_with_the_reason(operation, without_numba):
    with pytest.raises(
        ValueError, match=r"'numba' cannot be used: numba cannot be imported \(ImportError: gone\)"
    ):
        calls(torch.float32, "numba")[operation]()


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_backend_that_does_not_exist_is_named_with_those_that_do(operation, dtype):
    with pytest.raises(ValueError, match="there is no backend 'cuda'; choose auto, torch or numba"):
        calls(dtype, "cuda")[operation]()


@pytest.mark.parametrize(
    ("tensors", "kernels"),
    [
        ([LOW], True),
        ([LOW, LOW], True),
        ([HIGH], False),
        ([LOW, HIGH], False),
        ([LOW.half()], False),
        ([LOW.bfloat16(), LOW], False),
        ([LOW.to("meta")], False),
        ([LOW, LOW.to("meta")], False),
    ],
)
def test_auto_takes_the_kernels_only_if_all_numbers_are_float32_on_the_cpu(tensors: list[Tensor], kernels):
    assert use_numba("auto", *tensors) is kernels
    assert use_numba("torch", *tensors) is False
    if kernels:
        assert use_numba("numba", *tensors) is True
    else:
        with pytest.raises(ValueError, match=r"renders torch.float32 on cpu, not .*choose auto or torch"):
            use_numba("numba", *tensors)


def test_mixed_numbers_are_all_named():
    with pytest.raises(ValueError, match=r"not torch.float32 on cpu, torch.float64 on cpu;"):
        use_numba("numba", LOW, HIGH)


def test_numba_is_there():
    assert why_no_numba() == ""


@pytest.mark.parametrize(
    "error", [ImportError("needs NumPy 2.2 or less"), SystemError("no LLVM"), OSError("gone")]
)
def test_whatever_goes_wrong_with_numba_is_the_reason_why_it_is_not_used(error, monkeypatch):
    original = builtins.__import__

    def fails(name: str, *arguments: object, **options: object) -> object:
        if name == "numba":
            raise error
        return original(name, *arguments, **options)

    monkeypatch.delitem(sys.modules, "numba")
    monkeypatch.setattr(builtins, "__import__", fails)
    why_no_numba.cache_clear()
    try:
        assert why_no_numba() == f"numba cannot be imported ({type(error).__name__}: {error})"
        assert use_numba("auto", LOW) is False
    finally:
        why_no_numba.cache_clear()


def test_a_run_s_record_says_what_renders_why_and_on_how_many_threads():
    assert prepare_backend("auto", "cpu", 2) == {
        "backend": "numba",
        "reason": "numba is the fastest on cpu",
        "threads": 2,
    }
    assert prepare_backend("numba", "cpu") == {"backend": "numba", "reason": "asked for", "threads": 1}
    assert prepare_backend("torch", "cpu", 3) == {"backend": "torch", "reason": "asked for", "threads": 3}
    assert prepare_backend("auto", "cuda:1") == {
        "backend": "torch",
        "reason": "torch is the fastest on cuda",
        "threads": 1,
    }
    assert prepare_backend("torch", "cuda")["reason"] == "asked for"


def test_without_numba_the_record_says_why(without_numba):
    record = prepare_backend("auto", "cpu")
    assert record["backend"] == "torch"
    assert record["reason"] == "numba cannot be imported (ImportError: gone)"


def test_the_kernels_get_the_threads_and_torch_keeps_one():
    prepare_backend("auto", "cpu", 3)
    assert (torch.get_num_threads(), compilation.get_num_threads()) == (1, 3)


def test_torch_gets_the_threads_where_it_renders():
    prepare_backend("torch", "cpu", 2)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(
    ("name", "device", "said"),
    [
        ("numba", "cuda", "'numba' renders on the cpu, not on cuda; choose auto or torch"),
        ("fortran", "cpu", "there is no backend 'fortran'; choose auto, torch or numba"),
        ("fortran", "cuda", "there is no backend 'fortran'; choose auto, torch or numba"),
    ],
)
def test_a_run_that_cannot_be_prepared_says_so(name, device, said):
    with pytest.raises(ValueError, match=said):
        prepare_backend(name, device)


@pytest.mark.parametrize("name", ["auto", "numba", "torch"])
def test_no_thread_at_all_is_refused(name):
    with pytest.raises((ValueError, RuntimeError), match=r"threads|positive"):
        prepare_backend(name, "cpu", 0)


def test_a_rendering_remembers_which_backend_it_was_asked_for(kernels_called):
    scene = bumpy_sphere((20, 20), frequency=2)
    for name in ("torch", "numba"):
        result = render(faces=scene.faces, size=scene.size, backend=name, **scene.arguments(torch.float32))
        kernels_called.clear()
        assert result.points.shape == result.normals.shape == (len(result.pixels), 3)
        assert bool(kernels_called) is (name == "numba")


def test_both_backends_draw_the_same_closed_form_texture():
    mesh = bumpy_sphere((48, 48), views=1, frequency=6)
    texels = TexelMap.of(mesh.face_uvs.float(), 16)
    seen = torch.rand(3, 48, 48, generator=torch.Generator().manual_seed(0))
    vertices, R, t, K = (part.float() for part in (mesh.vertices, mesh.R[0], mesh.t[0], mesh.K[0]))
    numba, twin = (
        back_project(seen, torch.ones(48, 48), vertices, mesh.faces, texels, R, t, K, name)
        for name in ("numba", "torch")
    )
    torch.testing.assert_close(numba.total, twin.total)
    torch.testing.assert_close(numba.weight, twin.weight)


def test_kernels_that_are_not_compiled_are_not_used_and_that_is_told(monkeypatch, caplog):
    why_no_numba.cache_clear()
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    try:
        chosen = prepare_backend("auto", "cpu")
        assert (chosen["backend"], "NUMBA_DISABLE_JIT is set" in str(chosen["reason"])) == ("torch", True)
        assert "NUMBA_DISABLE_JIT is set" in caplog.text
        with pytest.raises(ValueError, match="NUMBA_DISABLE_JIT"):
            prepare_backend("numba", "cpu")
    finally:
        why_no_numba.cache_clear()


@pytest.mark.parametrize("renderer", ["auto", "torch"])
def test_nothing_is_tracked_without_numba_whatever_renders(renderer, monkeypatch):
    monkeypatch.setattr(components, "why_no_numba", lambda: "numba cannot be imported (ImportError: gone)")
    with pytest.raises(InputError, match=r"needs Numba to compile its kernels: numba cannot be imported"):
        components.select_renderer(RuntimeConfig(renderer=renderer))
