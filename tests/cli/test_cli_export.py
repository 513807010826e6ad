"""``tracking3d export``: what it prints, and how it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tracking3d.export.exporting import Export
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
    assert (finished / "export" / "run.csv").is_file()


def test_a_run_that_has_not_ended_is_exported_as_far_as_it_is(call, finished):
    file = finished / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"state": "interrupted"}))
    result = call("export", finished, "--to", "vot", "--out", "masks.txt")
    assert result.exit_code == 0
    assert "is interrupted; frames estimated so far: 5" in result.stderr


def test_all_objects_of_a_run_are_exported_each_into_its_folder(call, refused, clip, script):
    assert call("run", clip, *BOX, "--box", "5,5,9,9", "--out", "both").exit_code == 0
    result = call("export", "both", "--to", "stl")
    files = [Path(f"both/object_{number}/export/both_object_{number}.stl") for number in (0, 1)]
    assert result.exit_code == 0, result.output
    assert [file.is_file() for file in files] == [True, True]
    assert [line.split(":")[0] for line in result.stdout.splitlines()] == [f"Wrote {file}" for file in files]
    told = call("export", "both", "--to", "stl", "--json", "--overwrite").stdout.splitlines()
    assert [json.loads(line)["path"] for line in told] == [str(file) for file in files]
    assert "both holds 2 objects" in refused("export", "both", "--to", "stl", "--out", "a.stl")


def test_the_start_of_a_video_is_a_number_or_a_date(call, refused, finished, monkeypatch):
    asked = []

    def export_run(*_, options, **__):
        asked.append(options.start_time)
        return Export(Path("bag"), None, 0, ())

    monkeypatch.setattr("tracking3d.export.exporting.export_run", export_run)
    command = ("export", finished, "--to", "ros-bag", "--start-time")
    for text in ("100.5", "1970-01-01T00:01:40.5Z", "1970-01-01T00:01:40.5", "1970-01-01T01:01:40.5+01:00"):
        assert call(*command, text).exit_code == 0
    assert asked == [100.5] * 4
    assert "--start-time 'noon' is no time" in refused(*command, "noon")


@pytest.mark.parametrize("text", ["0", "-5", "nan", "1e10"])
def test_stamps_that_ros_cannot_hold_are_refused(refused, finished, text):
    assert "the end of ROS's clock" in refused("export", finished, "--to", "mcap", "--start-time", text)


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
