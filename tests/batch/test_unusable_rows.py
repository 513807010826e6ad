"""A row of a table that cannot be used is one failed video, whatever is in it; the others are tracked."""

from __future__ import annotations

import json
import os
import sys

import pytest
from small_videos import BOX

from tracking3d.batch.folder import read_failures, read_result_rows
from tracking3d.batch.listing import list_jobs
from tracking3d.config.loading import load_config
from tracking3d.errors import InputError

DEEP = 100_000
JSON_ROWS = {
    "NUL in the video": r'{"video": "one\u0000.mp4", "box": "1,2,3,4"}',
    "NUL in a box": r'{"video": "one.mp4", "box": ["1,2,3,4\u0000"]}',
    "NUL in a setting": r'{"video": "one.mp4", "settings": {"solver.name": {"a\u0000": 1}}}',
    "lone surrogate in the video": r'{"video": "one\ud800.mp4", "box": "1,2,3,4"}',
    "lone surrogate in the name": r'{"video": "one.mp4", "box": "1,2,3,4", "name": "\udfff"}',
    "lone surrogate in a column": r'{"video": "one.mp4", "\ud812": 1}',
    "brackets": "[" * DEEP,
    "brackets and braces": '{"a":[' * (DEEP // 2),
    "brackets that are closed": "[" * DEEP + "]" * DEEP,
    "brackets in a value": '{"video": "one.mp4", "box": ' + "[" * DEEP + "]" * DEEP + "}",
    "brackets that can be read": '{"video": "one.mp4", "box": ' + "[" * 900 + "]" * 900 + "}",
    "a text of brackets": json.dumps({"video": "[" * DEEP, "box": BOX}),
    "a long name": json.dumps({"video": "one.mp4", "box": BOX, "name": "é" * 150}),
    "settings of brackets": json.dumps(
        {"video": "one.mp4", "box": BOX, "settings": "solver.iterations=" + "[" * DEEP}
    ),
    "brackets for a video": '{"video": ' + "[" * 900 + "]" * 900 + "}",
    "no object": "[1, 2]",
    "no JSON": '{"video": "one.mp4"',
    "not UTF-8": b'{"video": "caf\xe9.mp4", "box": "1,2,3,4"}',
    "NUL bytes": b"\0" * 20,
    "an unknown column": '{"video": "one.mp4", "bx": 1}',
    "no video": '{"box": "1,2,3,4"}',
    "a large number": '{"video": "one.mp4", "split": 1' + 400 * "0" + "}",
    "a larger number": '{"video": "one.mp4", "start_frame": 1' + 5000 * "0" + "}",
    "the home of nobody": '{"video": "~nobody-of-this-name/one.mp4", "box": "1,2,3,4"}',
}
CSV_ROWS = {
    "NUL in the video": b'one\0.mp4,"1,2,3,4",,',
    "not UTF-8": b'caf\xe9.mp4,"1,2,3,4",,',
    "lone surrogate": b'one\xed\xa0\x80.mp4,"1,2,3,4",,',
    "brackets": b"[" * DEEP,
    "brackets for a box": b"one.mp4," + b"[" * DEEP + b",,",
    "brackets for a name": b"one.mp4,,," + b"[" * DEEP,
    "brackets for a setting": b'one.mp4,"1,2,3,4",solver.iterations=' + b"[" * DEEP + b",",
    "more values than columns": b"one.mp4,,,,,more",
    "no video": b',"1,2,3,4",,',
}


def configure(row):
    return load_config(overrides=row.settings)


def check(batch, table, line):
    progress, _ = batch(table, configure=configure)
    assert (progress.total, progress.finished, progress.failed, progress.state) == (2, 1, 1, "finished")
    out = str(table.parent.parent / "out")
    [row] = read_result_rows(out)
    [failure] = read_failures(out)
    assert row["run"].endswith("two") and failure.run != row["run"]
    reason = failure.reason
    assert (
        reason
        and len(reason) < 2500
        and "\n" not in reason
        and reason.isprintable()
        and "fault of" not in reason
    )
    assert failure.video.isprintable()
    if failure.run.startswith("line_"):
        assert failure.run == f"line_{line}" and f"Line {line} of" in reason


@pytest.mark.parametrize("kind", JSON_ROWS)
def test_a_line_of_json_that_cannot_be_used_is_one_failed_video(batch, videos, kind):
    bad = JSON_ROWS[kind]
    good = json.dumps({"video": "in/two.mp4", "box": BOX}).encode()
    table = videos / "jobs.jsonl"
    table.write_bytes(b"\n".join([good, b"", bad if isinstance(bad, bytes) else bad.encode()]))
    check(batch, table, 3)


@pytest.mark.parametrize("kind", CSV_ROWS)
def test_a_line_of_csv_that_cannot_be_used_is_one_failed_video(batch, videos, kind):
    table = videos / "jobs.csv"
    table.write_bytes(
        b"video,box,settings,name\n" + CSV_ROWS[kind] + b'\nin/two.mp4,"' + BOX.encode() + b'",,\n'
    )
    check(batch, table, 2)


def test_a_line_ends_where_json_says(videos):
    row = {"video": "one.mp4", "box": BOX, "name": "first\u2028second\x85third"}
    (videos / "jobs.jsonl").write_text(json.dumps(row, ensure_ascii=False) + "\r\n", encoding="utf-8-sig")
    [job] = list_jobs(str(videos / "jobs.jsonl"), configure)
    assert job.name == row["name"]


def test_unusable_rows_take_no_name_of_a_video(videos):
    rows = [{"video": "one.mp4", "box": BOX, "name": "line_2"}, {"video": "one\0.mp4"}]
    (videos / "jobs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    jobs = list_jobs(str(videos / "jobs.jsonl"), configure)
    assert [(job.name, bool(job.fault)) for job in jobs] == [("line_2", False), ("line_2_", True)]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("jobs.jsonl", b"[" * DEEP),
        ("jobs.jsonl", b"\xff\xfe{\0}\0\n\0"),
        ("jobs.csv", "video,box\none.mp4,\n".encode("utf-16")),
        ("jobs.csv", b"video,bx\none.mp4,\none.mp4,1\n"),
    ],
)
def test_a_table_of_which_nothing_can_be_used_is_refused(videos, name, content):
    (videos / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        list_jobs(str(videos / name), configure)


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="names of files are Unicode there")
def test_a_video_in_a_folder_whose_name_is_not_utf8_is_tracked(batch, videos):
    name = os.fsdecode(b"caf\xe9")
    for suffix in (".mp4", ".box"):
        (videos / "one").with_suffix(suffix).rename(videos / f"{name}{suffix}")
    progress, _ = batch(videos)
    assert (progress.finished, progress.failed) == (2, 0)
    assert (videos.parent / "out" / name / "batch.json").is_file()
