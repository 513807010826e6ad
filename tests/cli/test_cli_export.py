"""``tracking3d export``: what it prints, and how it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tracking3d.export.formats import FORMATS

BOX = ("--box", "20,10,20,20")


@pytest.fixture
def finished(call, clip, script) -> Path:
    assert call("run", clip, *BOX, "--out", "run").exit_code == 0
    return Path("run")


def test_the_formats_are_listed(call):
    listed = json.loads(call("export", "--list", "--json").stdout)
    assert [row["name"] for row in listed] == list(FORMATS)
    text = call("export", "--list").stdout
    assert all(name in text for name in FORMATS)


def test_an_export_says_where_it_is(call, finished):
    result = call("export", finished, "--to", "tum", "--out", "poses.txt")
    said = "Wrote poses.txt: 5 frames, lengths in the arbitrary unit of the run.\n"
    assert (result.exit_code, result.stdout, result.stderr) == (0, said, "")
    metric = call("export", finished, "--to", "tum", "--out", "metric.txt", "--object-size", "0.2")
    assert metric.stdout == "Wrote metric.txt: 5 frames.\n"
    assert call("export", finished, "--to", "vot", "--out", "m.txt").stdout == "Wrote m.txt: 5 frames.\n"
    lines = Path("poses.txt").read_text().splitlines()
    assert lines[3].split()[:4] == ["0", "0.000000000", "0.000000000", "3.000000000"]
    told = json.loads(call("export", finished, "--to", "kitti", "--out", "kitti", "--json").stdout)
    assert told == {"path": "kitti", "unit": "arbitrary", "frames": 5, "without": []}
    assert call("export", finished, "--to", "csv", "--quiet").stdout == ""
    assert (finished / "export" / "csv.csv").is_file()


def test_a_run_that_has_not_ended_is_exported_as_far_as_it_is(call, finished):
    file = finished / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"state": "interrupted"}))
    result = call("export", finished, "--to", "vot", "--out", "masks.txt")
    assert result.exit_code == 0
    assert "is interrupted; frames estimated so far: 5" in result.stderr


def test_pixels_are_followed(call, finished):
    result = call("export", finished, "--to", "points-csv", "--xy", "31,23", "--frame", "1", "--out", "p.csv")
    assert result.exit_code == 0, result.output
    assert len(Path("p.csv").read_text().splitlines()) == 1 + 5


def test_what_cannot_be_used_is_refused(call, refused, finished):
    assert "--list" in refused("export")
    assert "--list" in refused("export", finished)
    assert "There is no format fbx (--to takes tum" in refused("export", finished, "--to", "fbx")
    assert "absent is not a run folder" in refused("export", "absent", "--to", "tum")
    assert "does not use --cut-out" in refused("export", finished, "--to", "tum", "--cut-out")
    assert "--object-size is -1" in refused("export", finished, "--to", "tum", "--object-size", "-1")
    assert "--of must be object or camera" in refused("export", finished, "--to", "tum", "--of", "hand")
    assert "--xy 'a' is not 2 numbers" in refused("export", finished, "--to", "tapvid", "--xy", "a")
    assert call("export", finished, "--to", "tum").exit_code == 0
    assert "pass --overwrite" in refused("export", finished, "--to", "tum")
