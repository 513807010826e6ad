"""The aliked plug-in: kornia's network with weights from a file, and nothing else from it."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch
from kornia.feature import ALIKED
from safetensors.torch import save_file
from tracking3d_aliked import AlikedEncoder

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.testing import check_encoder

EXPORT = Path(__file__).resolve().parents[4] / "shared" / "models" / "aliked-n16_dense.onnx"


@pytest.fixture(scope="module")
def network() -> ALIKED:
    torch.manual_seed(0)
    return ALIKED("aliked-t16").eval()


def encoder(file: Path, variant: str = "t16") -> AlikedEncoder:
    return AlikedEncoder.from_options(AlikedEncoder.Options(weights=str(file), variant=variant))


@pytest.mark.parametrize("kind", ["safetensors", "pth", "state_dict"])
def test_weights_come_from_the_file(network, tmp_path, kind):
    file = tmp_path / f"weights.{'safetensors' if kind == 'safetensors' else 'pth'}"
    state = network.state_dict()
    if kind == "safetensors":
        save_file(state, file)
    else:
        torch.save({"state_dict": state} if kind == "state_dict" else state, file)
    image = torch.rand(1, 3, 40, 56, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        torch.testing.assert_close(encoder(file).encode(image), network.extract_dense_map(image)[0])


def test_it_keeps_to_the_protocol(network, tmp_path):
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    made = encoder(tmp_path / "weights.pth")
    assert (made.channels, made.stride) == (64, 1)
    check_encoder(made, size=64)


def test_weights_without_the_keypoint_head_will_do(network, tmp_path):
    state = {name: value for name, value in network.state_dict().items() if "desc_head" not in name}
    torch.save(state, tmp_path / "weights.pth")
    assert encoder(tmp_path / "weights.pth").channels == 64


def test_weights_of_another_variant_are_refused(network, tmp_path):
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    with pytest.raises(InputError, match=r"ALIKED-n16: block1.*set features\.variant"):
        encoder(tmp_path / "weights.pth", "n16")


class Trap:
    """What a malicious checkpoint holds: code that runs when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_nothing_in_a_file_is_run(tmp_path):
    trap = tmp_path / "trap.pth"
    torch.save({"state_dict": Trap(tmp_path / "sprung")}, trap)
    plain = tmp_path / "plain.pth"
    plain.write_bytes(pickle.dumps(Trap(tmp_path / "sprung")))
    for file in (trap, plain):
        with pytest.raises(InputError, match="holds more than tensors"):
            encoder(file)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.pth", None, "do not exist"),
        ("empty.pth", b"", "cannot be read"),
        ("broken.safetensors", b"\x10\0\0\0\0\0\0\0rubbish", "cannot be read"),
        ("net.onnx", b"", "--features onnx"),
    ],
)
def test_files_that_are_no_weights_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        encoder(tmp_path / name)


def test_a_file_of_numbers_is_refused(tmp_path):
    torch.save({"epoch": 3}, tmp_path / "numbers.pth")
    with pytest.raises(InputError, match="no state dict of tensors"):
        encoder(tmp_path / "numbers.pth")


@pytest.mark.skipif(not EXPORT.is_file(), reason="the development models beside the checkout are absent")
def test_it_gives_what_the_onnx_export_of_the_same_weights_gives(tmp_path):
    torch.save(weights_of_export(), tmp_path / "weights.pth")
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    exported = torch.from_numpy(Network(EXPORT).run({"image": image.numpy()})["desc"])
    torch.testing.assert_close(
        encoder(tmp_path / "weights.pth", "n16").encode(image), exported, atol=1e-3, rtol=0
    )


def weights_of_export() -> dict[str, torch.Tensor]:
    """The state dict behind the export, which has folded batch norms away and kernels cut into rows."""
    onnx = pytest.importorskip("onnx")
    found = {
        tensor.name: torch.from_numpy(onnx.numpy_helper.to_array(tensor).copy())
        for tensor in onnx.load(EXPORT).graph.initializer
    }
    state = {name.removeprefix("m.0."): value for name, value in found.items() if name.startswith("m.0.")}
    unnamed = sorted(
        (name for name in found if name.startswith("onnx::")), key=lambda name: int(name.partition("_")[2])
    )
    plain = [name for name in unnamed if found[name].ndim != 3]
    rows = [name for name in unnamed if found[name].ndim == 3]
    convolutions = [f"block{block}.conv{number}" for block in (1, 2) for number in (1, 2)]
    for convolution, weight, bias in zip(convolutions, plain[::2], plain[1::2], strict=True):
        norm = convolution.replace("conv", "bn")
        state[f"{convolution}.weight"] = found[weight]
        channels = len(found[bias])
        state[f"{norm}.weight"] = torch.ones(channels)
        state[f"{norm}.bias"] = found[bias]
        state[f"{norm}.running_mean"] = torch.zeros(channels)
        state[f"{norm}.running_var"] = torch.ones(channels) - 1e-5
    for position, number in enumerate([(3, 1), (3, 2), (4, 1), (4, 2)]):
        kernel = torch.stack([found[name] for name in rows[3 * position : 3 * position + 3]], dim=2)
        state["block{}.conv{}.regular_conv.weight".format(*number)] = kernel
    return state
