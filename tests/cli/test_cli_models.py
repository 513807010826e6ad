"""``tracking3d models``: list, get and verify, in text and in JSON, with a catalogue of the test's own."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from tracking3d.features.networks import store
from tracking3d.features.networks.catalogue import KnownNetwork, recommended_networks

BYTES = b"an ONNX network, nearly"


@pytest.fixture
def catalogue(monkeypatch, tmp_path) -> Path:
    """Two known networks, one of which no address is known and whose licence is not for everyone; gives the cache."""
    common = {"purpose": "tests", "authors": "https://example.org", "size": len(BYTES)}
    common["sha256"] = hashlib.sha256(BYTES).hexdigest()
    networks = {
        "open": KnownNetwork(
            name="open", licence="MIT", address="http://nowhere.invalid/open.onnx", **common
        ),
        "closed": KnownNetwork(name="closed", licence="mine", non_commercial=True, how="ask", **common),
    }
    monkeypatch.setattr(store, "known_networks", lambda: networks)
    monkeypatch.setattr("tracking3d.features.networks.catalogue.known_networks", lambda: networks)
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path / "cache"))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "fetched").write_bytes(BYTES)
    return tmp_path / "cache" / "models"


def rows(output: str) -> list[list[str]]:
    lines = [line for line in output.splitlines() if line.startswith("│")]
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in lines]


def test_the_list_says_what_for_how_large_which_licence_and_whether_it_is_there(call, catalogue):
    assert rows(call("models", "list").stdout) == [
        ["open", "tests", "0.0 MB", "MIT", ""],
        ["closed", "tests", "0.0 MB", "mine non-commercial", "manual"],
    ]
    call("models", "get", "open", "--from", "fetched")
    assert rows(call("models", "list").stdout)[0][-1] == "fetched"


def test_the_list_as_json_has_everything_that_is_known(call, catalogue):
    listed = {row["name"]: row for row in json.loads(call("models", "list", "--json").stdout)}
    assert set(listed["open"]) == {*KnownNetwork.model_fields, "path", "fetched"}
    assert listed["open"]["path"] == str(catalogue / "open.onnx")
    assert (listed["open"]["fetched"], listed["closed"]["address"]) == (False, None)


def test_the_real_list_flags_what_is_not_for_everyone(call):
    [flagged] = [row for row in rows(call("models", "list").stdout) if "non-commercial" in row[3]]
    assert flagged[0] == "rmbg-1.4"


def test_get_without_a_network_is_one_sentence(refused, catalogue):
    told = refused("models", "get", "open")
    assert "http://nowhere.invalid/open.onnx" in told
    assert str(catalogue / "open.onnx") in told
    assert list(catalogue.iterdir()) == []


def test_get_takes_a_file_once_and_asks_for_no_network_after_that(call, catalogue):
    result = call("models", "get", "open", "--from", "fetched")
    assert (result.exit_code, result.stdout) == (0, f"{catalogue / 'open.onnx'}: open, MIT\n")
    assert call("models", "get", "open").stdout == result.stdout
    assert call("models", "get", "open", "--quiet").stdout == ""


def test_get_asks_for_the_licence_to_be_accepted(call, refused, catalogue):
    assert "--accept-licence" in refused("models", "get", "closed")
    assert "--accept-licence" in refused("models", "get", "closed", "--from", "fetched")
    assert call("models", "get", "closed", "--from", "fetched", "--accept-licence").exit_code == 0


def test_get_takes_several_and_goes_on_after_one_that_fails(call, catalogue):
    (catalogue / "closed.onnx").parent.mkdir(parents=True)
    (catalogue / "closed.onnx").write_bytes(BYTES)
    result = call("models", "get", "open", "open", "closed")
    assert result.exit_code == 2
    assert result.stderr.count("open could not be downloaded") == 1
    assert result.stdout == f"{catalogue / 'closed.onnx'}: closed, mine\n"
    assert "open could not be downloaded" in result.stderr


def test_get_recommended_stands_for_the_recommended_networks(call, refused, catalogue, monkeypatch):
    from tracking3d.features.networks.catalogue import known_networks

    chosen = [known_networks()["open"].model_copy(update={"recommended": True})]
    monkeypatch.setattr("tracking3d.features.networks.catalogue.recommended_networks", lambda: chosen)
    call("models", "get", "open", "--from", "fetched")
    assert call("models", "get", "recommended").stdout == f"{catalogue / 'open.onnx'}: open, MIT\n"
    assert "exactly one NAME" in refused("models", "get", "recommended", "--from", "fetched")


def test_what_is_recommended_can_be_downloaded_and_is_small():
    recommended = recommended_networks()
    assert [network.name for network in recommended] == ["u2netp", "nanotrack3-backbone", "nanotrack3-head"]
    assert sum(network.size or 0 for network in recommended) < 8e6
    assert all(network.addresses and not network.non_commercial for network in recommended)


def test_get_all_is_what_has_an_address_and_a_licence_for_everyone(call, catalogue):
    call("models", "get", "open", "--from", "fetched")
    assert call("models", "get", "--all").stdout == f"{catalogue / 'open.onnx'}: open, MIT\n"


@pytest.mark.parametrize(
    "arguments",
    [[], ["open", "--all"], ["--all", "--from", "fetched"], ["open", "closed", "--from", "fetched"]],
)
def test_get_wants_names_or_all_and_one_name_for_a_file(refused, catalogue, arguments):
    assert "one or more NAMEs, or --all" in refused("models", "get", *arguments)


def test_get_asks_the_mirror_that_is_named(refused, catalogue, monkeypatch):
    monkeypatch.setenv("TRACKING3D_MIRROR", "http://mirror.invalid/networks")
    assert "http://mirror.invalid/networks/open.onnx" in refused("models", "get", "open")
    assert "ftp://x is not an address" in refused("models", "get", "open", "--mirror", "ftp://x")


def test_get_says_how_to_come_by_what_it_cannot_fetch(refused, catalogue):
    assert "ask (https://example.org)" in refused("models", "get", "closed", "--accept-licence")


def test_get_refuses_what_it_does_not_know(refused, catalogue):
    assert "did you mean 'open'?" in refused("models", "get", "opn")
    Path("other").write_bytes(b"x" * len(BYTES))
    assert "SHA-256" in refused("models", "get", "open", "--from", "other")
    assert "absent cannot be read" in refused("models", "get", "open", "--from", "absent")


def test_verify_compares_what_is_in_the_cache(call, refused, catalogue):
    assert "holds no network" in call("models", "verify").stdout
    assert "models get open" in refused("models", "verify", "open")
    call("models", "get", "open", "--from", "fetched")
    assert call("models", "verify").stdout == call("models", "verify", "open").stdout == "open: ok\n"
    assert json.loads(call("models", "verify", "--json").stdout) == {"open": "ok"}


def test_verify_fails_on_a_damaged_file_and_get_mends_it(call, catalogue):
    call("models", "get", "open", "--from", "fetched")
    (catalogue / "open.onnx").write_bytes(b"damaged")
    result = call("models", "verify")
    assert result.exit_code == 2
    assert result.stdout == "open: not the known file\n"
    assert "models get open" in result.stderr
    assert call("models", "get", "open", "--from", "fetched").exit_code == 0
    assert call("models", "verify").exit_code == 0
