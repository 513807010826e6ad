"""Networks arrive whole and right or not at all, and every failure says what to download and where to put it."""

from __future__ import annotations

import os
import pickle
import socket
from pathlib import Path

import onnxruntime
import pytest
from known_bytes import BYTES

from tracking3d.errors import InputError, OutputError
from tracking3d.features.networks.download import adopt, fetch
from tracking3d.features.networks.store import network_path


def files_in(cache: Path) -> list[str]:
    return sorted(str(path.relative_to(cache)) for path in cache.rglob("*") if path.is_file())


def refused(cache: Path, error: type[Exception], words: str, call, *given, **named) -> str:
    """Call, expect one sentence with these words, and nothing left in the cache."""
    with pytest.raises(error, match=words) as caught:
        call(*given, **named)
    assert "\n" not in str(caught.value)
    assert files_in(cache) == []
    return str(caught.value)


def test_a_network_is_fetched_and_its_bytes_are_counted(cache, network, serve):
    arrived: list[int] = []
    net = network(address=serve())
    assert fetch(net, listener=arrived.append) == cache / "models" / "tiny-net.onnx"
    assert network_path(net).read_bytes() == BYTES
    assert sum(arrived) == len(BYTES)
    assert len(arrived) > 1
    assert files_in(cache) == ["models/tiny-net.onnx"]


def test_a_damaged_file_is_replaced(cache, network, serve):
    net = network(address=serve())
    network_path(net).parent.mkdir(parents=True)
    network_path(net).write_bytes(b"damaged")
    fetch(net)
    assert network_path(net).read_bytes() == BYTES


def test_other_bytes_are_refused_by_their_hash(cache, network, serve):
    address = serve(BYTES[:-1] + b"!")
    told = refused(cache, InputError, r"SHA-256 is [0-9a-f]{64} instead of", fetch, network(address=address))
    assert address in told
    assert "models get tiny-net --from FILE" in told


def test_a_wrong_download_leaves_a_good_file_in_place(cache, network, serve):
    fetch(network(address=serve()))
    with pytest.raises(InputError, match="SHA-256"):
        fetch(network(address=serve(b"!" * len(BYTES))))
    assert network_path(network()).read_bytes() == BYTES


def test_a_page_that_is_not_there_is_told_with_its_number(cache, network, serve):
    refused(cache, InputError, r"404 Not Found", fetch, network(address=serve(b"gone", status=404)))


def test_a_body_that_breaks_off_is_refused_and_what_came_is_kept_beside_the_place(cache, network, serve):
    net = network(address=serve(BYTES[:1000], claimed=len(BYTES)))
    with pytest.raises(InputError, match=f"broke after 1000 of {len(BYTES)} bytes"):
        fetch(net)
    assert not network_path(net).exists()
    [kept] = files_in(cache)
    assert kept == f"models/.tiny-net.onnx.{net.sha256[:12]}.part"
    assert (cache / kept).read_bytes() == BYTES[:1000]


def test_a_body_that_is_too_long_is_not_read_to_its_end(cache, network, serve):
    arrived: list[int] = []
    net = network(address=serve(BYTES * 20))
    refused(cache, InputError, f"more than {len(BYTES)} bytes", fetch, net, listener=arrived.append)
    assert sum(arrived) < 2 * len(BYTES)


def test_without_a_network_one_sentence_says_what_to_download_and_where_to_put_it(cache, network):
    with socket.socket() as closed:  # a port on which nobody listens
        closed.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{closed.getsockname()[1]}/tiny-net.onnx"
    told = refused(cache, InputError, "could not be downloaded", fetch, network(address=address))
    for part in (address, "tracking3d models get tiny-net --from FILE", str(cache / "models/tiny-net.onnx")):
        assert part in told


def test_a_host_that_does_not_exist_is_told(cache, network):
    refused(
        cache, InputError, "could not be downloaded", fetch, network(address="http://nowhere.invalid/n.onnx")
    )


def test_what_all_addresses_fail_for_is_told_once(cache, network):
    net = network(address="http://nowhere.invalid/n.onnx", mirrors=("http://neither.invalid/n.onnx",))
    told = refused(cache, InputError, "could not be downloaded", fetch, net)
    one, other = "http://nowhere.invalid/n.onnx", "http://neither.invalid/n.onnx"
    why = told.partition("(")[2].partition(")")[0]
    assert why.startswith(f"{one}, {other}: ") and why.count("http://") == 2


def test_after_ctrl_c_the_next_one_asks_for_the_rest_only(cache, network, serve_and_note):
    served = serve_and_note(ranges=True)
    net = network(address=served.address)

    def interrupt(count: int) -> None:
        if count:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(net, listener=interrupt)
    [kept] = files_in(cache)
    arrived = (cache / kept).stat().st_size
    assert 0 < arrived < len(BYTES)
    told: list[int] = []
    assert fetch(net, listener=told.append).read_bytes() == BYTES
    assert [wanted for _, wanted in served.asked] == ["", f"bytes={arrived}-"]
    assert (told[0], sum(told)) == (arrived, len(BYTES))
    assert files_in(cache) == ["models/tiny-net.onnx"]


def test_a_connection_that_breaks_again_and_again_is_taken_up_where_it_broke(cache, network, serve_and_note):
    served = serve_and_note(ranges=True, breaks=[300_000, 400_000, None])
    told: list[int] = []
    assert fetch(network(address=served.address), listener=told.append).read_bytes() == BYTES
    assert [wanted for _, wanted in served.asked] == ["", "bytes=300000-", "bytes=700000-"]
    assert sum(told) == len(BYTES)


def test_a_server_without_ranges_is_asked_for_everything_again(cache, network, serve_and_note):
    served = serve_and_note(breaks=[300_000, None])
    told: list[int] = []
    assert fetch(network(address=served.address), listener=told.append).read_bytes() == BYTES
    assert len(served.asked) == 2
    assert sum(told) == len(BYTES)


@pytest.mark.parametrize(
    "kept", [b"other bytes" * 1000, BYTES[:-1] + b"!", BYTES * 2], ids=["part", "all", "more"]
)
def test_what_was_kept_of_other_bytes_is_thrown_away(cache, network, serve_and_note, kept):
    served = serve_and_note(ranges=True)
    net = network(address=served.address)
    part = cache / f"models/.tiny-net.onnx.{net.sha256[:12]}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(kept)
    told: list[int] = []
    assert fetch(net, listener=told.append).read_bytes() == BYTES
    assert sum(told) == len(BYTES)
    assert files_in(cache) == ["models/tiny-net.onnx"]


def test_a_server_whose_file_is_shorter_than_what_was_kept_is_asked_anew(cache, network, serve_and_note):
    served = serve_and_note(ranges=True, body=BYTES[:1000])
    net = network(address=served.address)
    part = cache / f"models/.tiny-net.onnx.{net.sha256[:12]}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(BYTES[:2000])
    with pytest.raises(InputError, match="broke after 1000"):
        fetch(net)


def test_mirrors_are_tried_in_order_until_one_has_the_known_bytes(cache, network, serve, serve_and_note):
    absent, wrong = serve(b"gone", status=404), serve(b"!" * len(BYTES))
    good, unasked = serve_and_note(), serve_and_note()
    net = network(address=absent, mirrors=[wrong, good.address, unasked.address])
    assert fetch(net).read_bytes() == BYTES
    assert (len(good.asked), len(unasked.asked)) == (1, 0)


def test_a_mirror_goes_on_with_what_the_first_address_gave(cache, network, serve_and_note):
    first, second = serve_and_note(ranges=True, breaks=[500_000, 0]), serve_and_note(ranges=True)
    assert fetch(network(address=first.address, mirrors=[second.address])).read_bytes() == BYTES
    assert [wanted for _, wanted in second.asked] == ["bytes=500000-"]


def test_where_no_mirror_helps_every_reason_is_told(cache, network, serve):
    addresses = serve(b"gone", status=404), serve(b"!" * len(BYTES))
    net = network(address=addresses[0], mirrors=addresses[1:])
    told = refused(cache, InputError, "404 Not Found", fetch, net)
    assert all(address in told for address in addresses)
    assert "SHA-256" in told


def test_a_mirror_of_ones_own_is_tried_first(cache, network, serve_and_note):
    served, own = serve_and_note(), serve_and_note()
    folder = own.address.removesuffix("/tiny-net.onnx") + "/networks/"
    fetch(network(address=served.address), mirror=folder)
    assert (served.asked, own.asked) == ([], [("/networks/tiny-net.onnx", "")])
    exported = network(address=None, how="export net.pth")
    assert fetch(exported, mirror=folder).read_bytes() == BYTES


def test_a_mirror_of_ones_own_is_checked_like_any_other(cache, network, serve):
    folder = serve(b"!" * len(BYTES)).rpartition("/")[0]
    unknown = network(address=None, sha256=None, size=None, how="export net.pth")
    exported = network(address=None, how="export net.pth")
    refused(cache, InputError, "SHA-256 is", fetch, exported, mirror=folder)
    refused(cache, InputError, "SHA-256 is unknown", fetch, unknown, mirror=folder)
    for wrong in ("ftp://mirror", "/etc", "file:///etc"):
        refused(cache, InputError, "is not an address", fetch, network(), mirror=wrong)


def test_a_proxy_of_the_environment_is_asked_instead(cache, network, serve_and_note, monkeypatch):
    proxy = serve_and_note()
    monkeypatch.setenv("http_proxy", proxy.address.removesuffix("/tiny-net.onnx"))
    address = "http://nowhere.invalid/tiny-net.onnx"
    assert fetch(network(address=address)).read_bytes() == BYTES
    assert proxy.asked == [(address, "")]


def test_hosts_without_a_proxy_are_asked_directly(cache, network, serve_and_note, monkeypatch):
    proxy, served = serve_and_note(), serve_and_note()
    monkeypatch.setenv("http_proxy", proxy.address.removesuffix("/tiny-net.onnx"))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    fetch(network(address=served.address))
    assert (len(served.asked), len(proxy.asked)) == (1, 0)


def test_https_goes_through_a_tunnel_of_the_proxy_and_its_refusal_is_told(
    cache, network, serve_and_note, monkeypatch
):
    proxy = serve_and_note()
    monkeypatch.setenv("https_proxy", proxy.address.removesuffix("/tiny-net.onnx"))
    secure = network(address="https://nowhere.invalid/tiny-net.onnx")
    refused(cache, InputError, "Tunnel connection failed: 403", fetch, secure)
    assert proxy.asked == [("nowhere.invalid:443", "CONNECT")]


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_cache_without_permission_is_told(cache, network, serve):
    cache.mkdir()
    cache.chmod(0o500)
    refused(cache, OutputError, "TRACKING3D_CACHE", fetch, network(address=serve()))


def test_a_cache_that_is_a_file_is_told(cache, network, serve):
    cache.write_text("not a folder")
    with pytest.raises(OutputError, match=r"cannot be written: .*TRACKING3D_CACHE"):
        fetch(network(address=serve()))


def test_a_full_disk_is_told_and_leaves_nothing(cache, network, serve, monkeypatch):
    from tracking3d.features.networks import download

    class Full:
        def __init__(self, part):
            self.part = part
            self.name = part.name

        def write(self, chunk):
            raise OSError(28, "No space left on device")

    write = download._write
    monkeypatch.setattr(download, "_write", lambda part, chunk: write(Full(part), chunk))
    refused(cache, OutputError, "No space left", fetch, network(address=serve()))


def test_a_non_commercial_network_is_flagged_before_the_download(cache, network, serve):
    net = network(address=serve(), non_commercial=True, licence="research-only")
    words = r"research-only, forbids commercial use: read it at .*example.org.*--accept-licence"
    refused(cache, InputError, words, fetch, net)
    assert fetch(net, accept_licence=True).is_file()


def test_a_network_without_an_address_says_how_to_come_by_it(cache, network):
    exported = network(address=None, sha256=None, size=None, how="export net.pth")
    told = refused(cache, InputError, r"export net\.pth \(https://example.org/tiny\), then", fetch, exported)
    assert "models get tiny-net --from FILE" in told
    measured = network(address=None, how="export net.pth")
    refused(cache, InputError, "give the path of your file; if its SHA-256 is", fetch, measured)


def test_a_file_fetched_elsewhere_is_taken_if_it_is_the_known_one(cache, network, tmp_path):
    (tmp_path / "download").write_bytes(BYTES)
    assert adopt(network(), tmp_path / "download").read_bytes() == BYTES
    assert (tmp_path / "download").is_file()
    assert files_in(cache) == ["models/tiny-net.onnx"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (BYTES[:-1] + b"!", "SHA-256"),
        (b"", "0 instead of"),
        (BYTES * 2, "more than"),
        (pickle.dumps({"state_dict": 1}), "instead of"),
    ],
    ids=["changed", "empty", "longer", "pickle"],
)
def test_another_file_is_refused(cache, network, tmp_path, content, words):
    (tmp_path / "other").write_bytes(content)
    refused(cache, InputError, rf"other is not tiny-net: .*{words}", adopt, network(), tmp_path / "other")


def test_an_absent_file_or_a_folder_is_refused(cache, network, tmp_path):
    for path in (tmp_path / "absent", tmp_path):
        refused(cache, InputError, "cannot be read", adopt, network(), path)


class Bomb:
    """Writes a file when it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("unpickled"),)


def test_without_a_known_hash_only_an_onnx_network_is_taken_and_nothing_is_unpickled(
    cache, network, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    unknown = network(address=None, sha256=None, size=None, how="export net.pth")
    Path("net.pth").write_bytes(pickle.dumps(Bomb()))
    refused(
        cache,
        InputError,
        r"net\.pth is not a network that onnxruntime can run",
        adopt,
        unknown,
        Path("net.pth"),
    )
    assert not Path("unpickled").exists()


def test_without_a_known_hash_an_onnx_network_is_taken(cache, network):
    [example] = list(Path(onnxruntime.__file__).parent.rglob("mul_1.onnx"))[:1] or [None]
    if example is None:
        pytest.skip("onnxruntime brings no example network")
    unknown = network(address=None, sha256=None, size=None, how="export net.pth")
    assert adopt(unknown, example).read_bytes() == example.read_bytes()


def test_a_non_commercial_file_is_flagged_too(cache, network, tmp_path):
    (tmp_path / "download").write_bytes(BYTES)
    net = network(non_commercial=True)
    refused(cache, InputError, "--accept-licence", adopt, net, tmp_path / "download")
    assert adopt(net, tmp_path / "download", accept_licence=True).is_file()
