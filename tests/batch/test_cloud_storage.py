"""Videos, tables and results in object stores, by servers on this machine that speak as S3 and GCS do: slow."""

from __future__ import annotations

import socket

import fsspec
import pytest

from tracking3d.batch.folder import read_failures, read_progress, read_result_rows
from tracking3d.batch.places import join_path
from tracking3d.batch.summary import MARKER

pytestmark = [
    pytest.mark.slow,
    # What clients leave open to the end of their processes, and what servers for tests are built with.
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"),
]


@pytest.fixture(scope="module")
def port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@pytest.fixture
def s3(port, monkeypatch):
    pytest.importorskip("s3fs", reason="the extra s3 is not installed")
    moto = pytest.importorskip("moto.server", reason="the extra storage-tests is not installed")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=port, verbose=False)
    server.start()
    yield "s3"
    server.stop()


@pytest.fixture
def gs(port, monkeypatch):
    pytest.importorskip("gcsfs", reason="the extra gcs is not installed")
    emulator = pytest.importorskip(
        "gcp_storage_emulator.server", reason="the extra storage-tests is not installed"
    )
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", f"http://127.0.0.1:{port}")
    monkeypatch.setenv("GOOGLE_CLOUD_PROJECT", "test")
    server = emulator.create_server("127.0.0.1", port, in_memory=True)
    server.start()
    yield "gs"
    server.stop()


@pytest.mark.parametrize("kind", ["s3", "gs"])
def test_a_batch_from_a_store_into_a_store(kind, request, batch, videos):
    bucket = f"{request.getfixturevalue(kind)}://clips"
    fsspec.config.conf.clear()
    files, _ = fsspec.core.url_to_fs(bucket)
    files.mkdir("clips")
    files.put(str(videos), "clips/videos", recursive=True)
    files.pipe_file("clips/videos/broken.mp4", b"nothing")
    files.pipe_file("clips/videos/broken.box", b"1,1,5,5")
    out = join_path(bucket, "runs")

    progress, _ = batch(join_path(bucket, "videos"), out=out)
    assert (progress.finished, progress.failed) == (2, 1)
    files.invalidate_cache()
    found = set(files.find("clips/runs"))
    for name in ("one", "in/two"):
        assert {f"clips/runs/{name}/{file}" for file in ("run.json", "frames.jsonl", MARKER)} <= found
    assert {"clips/runs/index.html", "clips/runs/logs/broken.log"} <= found
    assert sorted(row["run"] for row in read_result_rows(out)) == ["in/two", "one"]
    assert [failure.run for failure in read_failures(out)] == ["broken"]
    assert read_progress(out).state == "finished"

    table = join_path(bucket, "jobs.csv")
    files.pipe_file("clips/jobs.csv", b'video,box\nvideos/one.mp4,"30,20,36,24"\n')
    again, _ = batch(table, out=join_path(bucket, "by_table"))
    assert again.finished == 1
    once_more, _ = batch(table, out=join_path(bucket, "by_table"))
    assert once_more.before == 1
