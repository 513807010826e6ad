"""Any ONNX network becomes a feature encoder by a few lines of YAML."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_feature_networks import TensorProto, expected, helper, save, write_network
from torch.nn import functional

from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError
from tracking3d.features.networks.catalogue import description_names
from tracking3d.features.networks.session import Network
from tracking3d.features.onnx.encoder import (
    PACKAGE,
    EncoderDescription,
    OnnxEncoder,
    load_encoder_description,
)
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.plugins import FEATURES, build_plugin
from tracking3d.testing import check_encoder


@pytest.fixture
def images() -> torch.Tensor:
    return torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(0))


def encoder(file: Path, **description) -> OnnxEncoder:
    return OnnxEncoder(Network(file), EncoderDescription.model_validate(description))


def test_the_features_are_the_networks_map(tmp_path, images):
    made = encoder(write_network(tmp_path / "net.onnx", {"features": (4, 8)}), normalise="none")
    assert isinstance(made, FeatureEncoder)
    assert (made.channels, made.stride, made.tau) == (8, 4, 0.05)
    torch.testing.assert_close(made.encode(images), expected(images, 4, 8), atol=1e-6, rtol=1e-5)


def test_features_have_unit_length_unless_told_otherwise(tmp_path, images):
    features = encoder(write_network(tmp_path / "net.onnx", {"features": (4, 8)})).encode(images)
    torch.testing.assert_close(
        features, functional.normalize(expected(images, 4, 8), dim=1), atol=1e-6, rtol=1e-5
    )


def test_the_image_is_scaled_shifted_and_reordered(tmp_path, images):
    file = write_network(tmp_path / "net.onnx", {"features": (2, 4)})
    how = {"scale": 255, "mean": [100, 110, 120], "std": [50, 60, 70], "channels": "bgr"}
    mean, std = (torch.tensor(how[key], dtype=torch.float32)[:, None, None] for key in ("mean", "std"))
    seen = ((255 * images - mean) / std)[:, [2, 1, 0]]
    features = encoder(file, input=how, normalise="none").encode(images)
    torch.testing.assert_close(features, expected(seen, 2, 4), atol=1e-5, rtol=1e-4)


def test_other_sizes_are_padded_and_the_padding_is_cut_off(tmp_path):
    image = torch.rand(1, 3, 30, 45, generator=torch.Generator().manual_seed(1))
    file = write_network(tmp_path / "net.onnx", {"features": (4, 8)})
    features = encoder(file, input={"multiple": 16}, normalise="none").encode(image)
    assert features.shape == (1, 8, 7, 11)
    torch.testing.assert_close(features, expected(image, 4, 8), atol=1e-6, rtol=1e-5)


def test_other_sizes_can_be_resized_instead(tmp_path):
    ramp = torch.linspace(0, 1, 46).expand(1, 3, 30, 46)
    file = write_network(tmp_path / "net.onnx", {"features": (2, 8)})
    features = encoder(file, input={"multiple": 16, "fit": "resize"}, normalise="none").encode(ramp)
    assert features.shape == (1, 8, 15, 23)
    # A ramp that is resized there and back is the same ramp, but for the ends.
    torch.testing.assert_close(features[..., 2:-2], expected(ramp, 2, 8)[..., 2:-2], atol=0.02, rtol=0)


def test_a_network_of_one_size_only_is_fed_that_size(tmp_path):
    file = write_network(tmp_path / "net.onnx", {"features": (4, 8)}, sides=(32, 32))
    fixed = encoder(file, normalise="none")
    assert fixed.stride == 4
    colour = torch.tensor([0.2, 0.5, 0.9])[None, :, None, None].expand(1, 3, 48, 80)
    features = fixed.encode(colour)
    torch.testing.assert_close(features, expected(colour, 4, 8), atol=1e-6, rtol=1e-5)


def test_a_network_for_one_image_encodes_a_batch_one_by_one(tmp_path, images):
    outputs = {"features": (4, 8)}
    one = encoder(write_network(tmp_path / "one.onnx", outputs, batch=1))
    many = encoder(write_network(tmp_path / "many.onnx", outputs))
    torch.testing.assert_close(one.encode(images), many.encode(images), atol=1e-6, rtol=1e-5)


def test_a_network_of_half_precision_is_fed_half_precision(tmp_path, images):
    file = write_network(tmp_path / "net.onnx", {"features": (4, 8)}, kind="float16")
    features = encoder(file, normalise="none").encode(images)
    assert features.dtype == torch.float32
    torch.testing.assert_close(features, expected(images, 4, 8), atol=1e-2, rtol=1e-2)


@pytest.mark.parametrize("normalise", ["none", "unit", "each"])
def test_several_maps_are_brought_to_one_size_and_joined(tmp_path, images, normalise):
    file = write_network(tmp_path / "net.onnx", {"fine": (2, 4), "coarse": (4, 6)})
    made = encoder(file, output=["coarse", "fine"], normalise=normalise)
    assert (made.channels, made.stride) == (10, 4)
    coarse, fine = expected(images, 4, 6), functional.avg_pool2d(expected(images, 2, 4), 2)
    if normalise == "none":
        torch.testing.assert_close(made.encode(images)[:, :6], coarse, atol=1e-6, rtol=1e-5)
        # Bilinear resizing with antialiasing by one half is a wider average than that of two pixels.
        assert (made.encode(images)[:, 6:] - fine).abs().mean() < 0.05
        return
    length = made.encode(images).norm(dim=1)
    torch.testing.assert_close(length, torch.ones_like(length))
    share = made.encode(images)[:, :6].norm(dim=1)
    equal = torch.full_like(share, 0.5**0.5)
    assert torch.allclose(share, equal, atol=1e-5) == (normalise == "each")


def test_several_maps_can_be_added(tmp_path, images):
    file = write_network(tmp_path / "net.onnx", {"a": (4, 6), "b": (8, 6)})
    made = encoder(file, output=["a", "b"], combine="sum", normalise="none", stride=4)
    coarse = functional.interpolate(expected(images, 8, 6), scale_factor=2, mode="bilinear", antialias=True)
    torch.testing.assert_close(made.encode(images), expected(images, 4, 6) + coarse, atol=1e-5, rtol=1e-4)


def test_an_image_smaller_than_the_stride_has_one_feature(tmp_path):
    made = encoder(write_network(tmp_path / "net.onnx", {"features": (8, 4)}))
    assert made.encode(torch.rand(1, 3, 3, 5)).shape == (1, 4, 1, 1)


def test_the_answer_has_no_gradients(tmp_path, images):
    made = encoder(write_network(tmp_path / "net.onnx", {"features": (4, 8)}))
    assert not made.encode(images.requires_grad_()).requires_grad


def test_without_a_description_the_map_with_most_channels_is_taken(tmp_path, images):
    file = write_network(tmp_path / "net.onnx", {"score": (1, 1), "features": (8, 16)})
    made = OnnxEncoder.from_options(OnnxEncoder.Options(model=str(file)))
    assert (made.channels, made.stride) == (16, 8)
    torch.testing.assert_close(
        made.encode(images), functional.normalize(expected(images, 8, 16), dim=1), atol=1e-6, rtol=1e-5
    )


def test_maps_that_cannot_be_told_apart_are_asked_about(tmp_path):
    file = write_network(tmp_path / "net.onnx", {"left": (4, 8), "right": (4, 8)})
    with pytest.raises(
        InputError, match=r"left \(1, 8, 16, 16\), right .*features.description.*'output: left'"
    ):
        encoder(file)


def test_a_network_without_a_map_is_refused(tmp_path):
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])
    vector = helper.make_tensor_value_info("vector", TensorProto.FLOAT, [1, None])
    nodes = [helper.make_node("Flatten", ["image"], ["vector"])]
    file = save(tmp_path / "net.onnx", nodes, [image], [vector], [])
    with pytest.raises(InputError, match=r"vector \(1, 12288\).*ambiguous"):
        encoder(file)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"output": "desc"}, r"no feature map 'desc'.*returns coarse \(1, 6, 16, 16\), fine"),
        ({"input": {"name": "picture"}}, "no input 'picture'; it has image; correct input.name"),
        ({"output": ["coarse", "fine"], "combine": "sum"}, "6, 4 channels.*combine: concatenate"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(tmp_path, description, message):
    file = write_network(tmp_path / "net.onnx", {"coarse": (4, 6), "fine": (2, 4)})
    with pytest.raises(InputError, match=message):
        encoder(file, **description)


def test_a_network_of_two_images_is_refused(tmp_path):
    file = write_network(tmp_path / "net.onnx", {"features": (4, 8)}, inputs=("image", "other"))
    with pytest.raises(InputError, match="inputs image, other, but a feature network takes only an image"):
        encoder(file)


def test_a_network_of_grey_images_is_refused(tmp_path):
    image = helper.make_tensor_value_info("grey", TensorProto.FLOAT, [1, 1, "h", "w"])
    features = helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, 1, "h", "w"])
    nodes = [helper.make_node("Identity", ["grey"], ["features"])]
    file = save(tmp_path / "net.onnx", nodes, [image], [features], [])
    with pytest.raises(InputError, match=r"'grey' of .* is \(1, 1, any, any\) of float32"):
        encoder(file)


def test_files_that_are_absent_or_no_network_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"absent\.onnx does not exist"):
        OnnxEncoder.from_options(OnnxEncoder.Options(model=str(tmp_path / "absent.onnx")))
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"not a network")
    with pytest.raises(InputError, match="not a network that onnxruntime can run"):
        OnnxEncoder.from_options(OnnxEncoder.Options(model=str(broken)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("strid: 4", "strid"),
        ("stride: 0", "stride"),
        ("input: {std: [1, 0, 1]}", "std"),
        ("input: {fit: crop}", "fit"),
        ("normalise: .nan", "normalise"),
        ("tau: .inf", "tau"),
        ("- output", "list"),
        ("output: !!python/object/apply:os.system [ls]", "refused"),
    ],
)
def test_a_description_with_a_fault_is_refused_with_its_file(tmp_path, text, message):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=rf"mine\.yaml.*{message}"):
        load_encoder_description(file)


def test_an_unknown_description_is_told_with_the_nearest_name():
    with pytest.raises(InputError, match=r"description of a feature network 'alik'.*did you mean 'alike'"):
        load_encoder_description("alik")


def test_an_empty_description_is_the_usual_network(tmp_path):
    file = tmp_path / "empty.yaml"
    file.write_text("")
    assert load_encoder_description(file) == EncoderDescription()


def test_every_description_that_comes_along_is_valid_and_says_where_from():
    assert description_names(PACKAGE) == ["alike", "aliked", "s2dnet_original", "xfeat"]
    for name in description_names(PACKAGE):
        assert load_encoder_description(name).link.startswith("https://")


def test_the_original_s2dnets_three_maps_become_one(tmp_path, images):
    outputs = {"conv1_2": (1, 128), "conv3_3": (4, 128), "conv5_3": (16, 128)}
    file = write_network(tmp_path / "s2dnet.onnx", outputs)
    made = OnnxEncoder(Network(file), load_encoder_description("s2dnet_original"))
    assert (made.channels, made.stride) == (384, 4)
    mean, std = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[..., None, None]
    middle = functional.normalize(expected((images - mean) / std, 4, 128), dim=1) / 3**0.5
    torch.testing.assert_close(made.encode(images)[:, 128:256], middle, atol=1e-5, rtol=1e-4)


def test_it_keeps_to_the_protocol(tmp_path):
    file = write_network(tmp_path / "net.onnx", {"features": (4, 8)})
    check_encoder(OnnxEncoder, model=str(file))


def test_it_is_built_by_name_with_a_users_description(tmp_path, monkeypatch):
    monkeypatch.setenv(
        "TRACKING3D_PLUGINS", "tracking3d.features:onnx=tracking3d.features.onnx.encoder:OnnxEncoder"
    )
    file = write_network(tmp_path / "net.onnx", {"a": (4, 8), "b": (4, 8)})
    (tmp_path / "mine.yaml").write_text("output: b\ntau: 0.1\n")
    choice = PluginChoice(name="onnx", model=str(file), description=str(tmp_path / "mine.yaml"))
    assert build_plugin(FEATURES, choice).tau == 0.1


@pytest.mark.parametrize(
    ("name", "description", "channels", "stride"),
    [
        ("alike-n_dense", "alike", 128, 1),
        ("aliked-n16_dense", "aliked", 128, 1),
        ("xfeat_dense", "xfeat", 64, 8),
    ],
)
def test_real_networks_are_encoders_with_a_description_or_without(
    shared_models, name, description, channels, stride
):
    file = shared_models / f"{name}.onnx"
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    raw = torch.from_numpy(Network(file).run({"image": image.numpy()})["desc"])
    for given in (description, None):
        made = OnnxEncoder.from_options(OnnxEncoder.Options(model=str(file), description=given))
        assert (made.channels, made.stride) == (channels, stride)
        torch.testing.assert_close(made.encode(image), functional.normalize(raw, dim=1))


@pytest.mark.parametrize("name", ["alike-n_dense", "xfeat_dense"])
def test_real_networks_keep_to_the_protocol(shared_models, name):
    check_encoder(OnnxEncoder, model=str(shared_models / f"{name}.onnx"), size=64)
