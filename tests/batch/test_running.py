"""A batch: what is whole appears, what fails is tried again and listed, what was stopped goes on."""

from __future__ import annotations

import csv
import json
import logging
from pathlib import Path

import fsspec
import pytest

from tracking3d.batch import folder as batch_folder
from tracking3d.batch.folder import read_failures, read_progress, read_result_rows
from tracking3d.batch.running import run_batch
from tracking3d.batch.storage import _open
from tracking3d.batch.summary import COLUMNS, MARKER
from tracking3d.config.loading import load_config
from tracking3d.engines.choosing import InThisProcess
from tracking3d.errors import InputError, OutputError
from tracking3d.results.files import try_lock
from tracking3d.results.run_reader import RunReader


def events(told, name):
    return [one.event for one in told if one.video == name]


def test_every_video_gets_a_run_folder_a_row_a_log_and_a_picture(batch, videos, tmp_path):
    progress, told = batch(videos)
    assert (progress.total, progress.finished, progress.failed, progress.state) == (2, 2, 0, "finished")
    out = tmp_path / "out"
    for name in ("one", "in/two"):
        assert RunReader(out / name).state == "finished"
        assert (out / "logs" / f"{name}.log").is_file()
        assert events(told, name) == ["began", "progress", "progress", "finished"]
    rows = read_result_rows(str(out))
    assert sorted(row["run"] for row in rows) == ["in/two", "one"]
    assert set(rows[0]) == set(COLUMNS) and rows[0]["frames"] == "2" and float(rows[0]["confidence"]) == 0.9
    assert read_failures(str(out)) == []
    page = (out / "index.html").read_text()
    assert page.count("data:image/jpeg") == 2 and "default-src &#39;none&#39;" in page
    assert not (out / ".work").exists()


def test_parquet_has_the_same_rows(batch, videos, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra export is not installed")
    batch(videos)
    with (tmp_path / "out/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = parquet.read_table(tmp_path / "out/results.parquet").to_pylist()
    assert [row["run"] for row in table] == [row["run"] for row in rows]
    assert [str(row["frames"]) for row in table] == [row["frames"] for row in rows]


def test_without_pyarrow_there_is_csv(batch, videos, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    batch(videos)
    assert len(read_result_rows(str(tmp_path / "out"))) == 2
    assert not (tmp_path / "out/results.parquet").exists()


def test_what_is_whole_is_not_done_again_and_is_in_the_tables_all_the_same(batch, videos, recorded, tmp_path):
    batch(videos)
    progress, told = batch(videos)
    assert len(recorded.calls) == 2 and progress.before == progress.finished == 2
    assert len(read_result_rows(str(tmp_path / "out"))) == 2
    assert {one.event for one in told} == {"batch"}
    batch(videos, overwrite=True)
    assert len(recorded.calls) == 4
    assert not (tmp_path / "out/.work").exists()


def test_a_run_of_other_settings_is_left_alone_and_said(batch, videos, tmp_path):
    batch(videos)
    before = (tmp_path / "out/one" / MARKER).read_bytes()
    progress, _ = batch(videos, configure=lambda row: load_config(overrides=["runtime.seed=3"]))
    assert progress.failed == 2
    assert "--overwrite" in read_failures(str(tmp_path / "out"))[0].reason
    assert (tmp_path / "out/one" / MARKER).read_bytes() == before


def test_a_folder_that_no_batch_has_written_is_left_alone(batch, videos, tmp_path):
    mine = tmp_path / "out/one/mine.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    progress, _ = batch(videos)
    assert (progress.finished, progress.failed) == (1, 1) and mine.read_text() == "mine"
    assert "not written by a batch" in read_failures(str(tmp_path / "out"))[0].reason


def test_a_batch_is_not_written_into_the_root_of_a_file_system(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "mkdir", lambda *given, **named: pytest.fail("a folder was made"))
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="is the root of a file system"):
            run_batch([], tmp_path.anchor, InThisProcess(), overwrite=overwrite)


def test_a_video_that_fails_once_goes_on_where_it_was(batch, videos, recorded, tmp_path):
    recorded.faults["one"] = [OutputError("The disk is full.")]
    progress, told = batch(videos)
    assert progress.failed == 0
    assert events(told, "one").count("again") == 1
    first, second = (call["folder"] for call in recorded.calls if "one" in call["source"].name)
    assert first == second and all(call["resume"] for call in recorded.calls)
    [row] = [row for row in read_result_rows(str(tmp_path / "out")) if row["run"] == "one"]
    assert row["attempts"] == "2"


def test_what_a_full_disk_has_left_of_a_note_costs_no_video(batch, videos, recorded, tmp_path):
    recorded.faults["one"] = [OutputError("The disk is full.")]
    assert batch(videos, retries=0)[0].failed == 1
    [note] = (tmp_path / "out/.work").glob("*/attempts")
    note.write_text("")
    assert batch(videos)[0].finished == 2


def test_a_video_that_never_succeeds_is_listed_with_its_reason_and_costs_nothing_else(
    batch, videos, tmp_path
):
    (videos / "broken.mp4").write_bytes(b"nothing")
    (videos / "broken.box").write_text("1,1,5,5")
    progress, _ = batch(videos, retries=2)
    assert (progress.finished, progress.failed) == (2, 1)
    [failure] = read_failures(str(tmp_path / "out"))
    assert failure.run == "broken" and failure.attempts == 3 and not failure.crashed
    assert "cannot be read as a video" in failure.reason
    assert (tmp_path / "out" / failure.log).is_file()
    assert not (tmp_path / "out/broken").exists() and not (tmp_path / "out/.work").exists()
    assert "cannot be read as a video" in (tmp_path / "out/index.html").read_text()


def test_ctrl_c_keeps_what_is_done_and_the_same_call_goes_on(batch, videos, recorded, tmp_path):
    (videos / "one.mp4").write_bytes(
        (videos / "one.mp4").read_bytes() + bytes(100)
    )  # the larger one goes first
    recorded.faults["two"] = [KeyboardInterrupt()]
    with pytest.raises(KeyboardInterrupt):
        batch(videos)
    out = str(tmp_path / "out")
    assert read_progress(out).state == "interrupted" and read_progress(out).finished == 1
    assert [row["run"] for row in read_result_rows(out)] == ["one"]
    assert not (tmp_path / "out/in/two").exists()
    [left] = (tmp_path / "out/.work").iterdir()
    progress, _ = batch(videos)
    assert progress.finished == 2 and progress.before == 1
    assert recorded.calls[-1]["folder"].parent == left


def test_several_objects_are_one_video_with_a_row_each(batch, videos, recorded, tmp_path):
    (videos / "one.box").write_text("1,1,20,20\n30,20,36,24\n")
    progress, _ = batch(videos)
    assert progress.finished == 2
    assert (tmp_path / "out/one/object_1/run.json").is_file()
    runs = {row["run"] for row in read_result_rows(str(tmp_path / "out"))}
    assert runs == {"one/object_0", "one/object_1", "in/two"}


def test_results_elsewhere_have_their_marker_last(batch, videos, monkeypatch):
    files, _ = _open("memory://results")
    put = []
    put_file = type(files).put_file

    def noted(self, source, target, **more):
        put.append(Path(target).name)
        put_file(self, source, target, **more)

    monkeypatch.setattr(type(files), "put_file", noted)
    try:
        progress, _ = batch(videos, out="memory://results")
        assert progress.finished == 2
        assert [place for place, name in enumerate(put) if name == MARKER] == [
            len(put) // 2 - 1,
            len(put) - 1,
        ]
        assert files.exists("/results/in/two/frames.jsonl") and files.exists("/results/logs/one.log")
        assert (
            len(read_result_rows("memory://results")) == 2 and read_progress("memory://results").finished == 2
        )
        again, _ = batch(videos, out="memory://results")
        assert again.before == 2
    finally:
        files.rm("/results", recursive=True)


def test_videos_elsewhere_are_fetched_and_not_kept(batch, videos, recorded, tmp_path):
    files = fsspec.filesystem("memory")
    files.put(str(videos), "/sources", recursive=True)
    try:
        progress, _ = batch("memory://sources")
    finally:
        files.rm("/sources", recursive=True)
    assert progress.finished == 2
    assert all(row["video"].startswith("memory://") for row in read_result_rows(str(tmp_path / "out")))
    assert not any(Path(call["source"].path).exists() for call in recorded.calls)


def test_a_table_that_cannot_be_written_is_said_and_the_videos_go_on(
    batch, videos, full_disk, tmp_path, caplog
):
    full_disk(batch_folder, "results.csv")
    with caplog.at_level(logging.WARNING), pytest.raises(OutputError, match="disk is full"):
        batch(videos)
    out = tmp_path / "out"
    assert not (out / "one").exists()  # it is said before anything is begun


def test_two_batches_do_not_share_a_folder(batch, videos, tmp_path):
    (tmp_path / "out").mkdir()
    with (tmp_path / "out/.lock").open("ab") as lock:
        assert try_lock(lock.fileno())
        with pytest.raises(OutputError, match="in use by another batch"):
            batch(videos)


def test_a_folder_of_no_batch_and_a_damaged_one_are_said(tmp_path):
    with pytest.raises(InputError, match="is not a batch folder"):
        read_progress(str(tmp_path))
    for text in ("{", "[]", json.dumps({"format": "other"}), json.dumps({"format": "tracking3d-batch"})):
        (tmp_path / "progress.json").write_text(text)
        with pytest.raises(InputError, match="is damaged"):
            read_progress(str(tmp_path))
    (tmp_path / "failures.csv").write_text("run,video\na,b\n")
    with pytest.raises(InputError, match="is damaged"):
        read_failures(str(tmp_path))


def test_a_batch_that_is_silent_for_long_is_said_to_be(batch, videos, tmp_path):
    batch(videos)
    file = tmp_path / "out/progress.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"state": "running", "updated": 0.0}))
    assert "without progress" in read_progress(str(tmp_path / "out")).state_in_words
