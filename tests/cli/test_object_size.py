"""``--object-size``: metres in every command that writes lengths, by one option."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import longest_side, visible_side

BOX = ("--box", "20,10,20,20")
SIZE = 0.22


@pytest.fixture
def finished(call, clip, script) -> Path:
    assert call("run", clip, *BOX, "--out", "run").exit_code == 0
    return Path("run")


def unit_in_glb(file: Path) -> dict:
    data = file.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length])["asset"]["extras"]


def test_a_run_with_a_size_is_written_in_metres(call, clip, script, finished):
    assert call("run", clip, *BOX, "--object-size", SIZE, "--out", "metric").exit_code == 0
    plain, metric = RunReader(finished), RunReader(Path("metric"))
    assert (plain.unit, metric.unit) == ("arbitrary", "metre")
    assert longest_side(load_model(Path("metric")).vertices) == pytest.approx(SIZE)
    scale = SIZE / longest_side(load_model(finished).vertices)
    assert metric.frames[2].T_cam_obj[2, 3] == pytest.approx(scale * plain.frames[2].T_cam_obj[2, 3])
    assert unit_in_glb(finished / "mesh.glb")["unit"] == "unknown"
    assert unit_in_glb(Path("metric/mesh.glb")) == {"unit": "metre"}
    assert "unit: metre" in Path("metric/mesh.obj").read_text().splitlines()[0]


def test_each_of_several_objects_gets_the_size(call, clip, script):
    assert call("run", clip, *BOX, "--box", "5,5,9,9", "--object-size", SIZE, "--out", "both").exit_code == 0
    assert [RunReader(Path(f"both/object_{n}")).unit for n in (0, 1)] == ["metre", "metre"]


def test_a_resumed_run_is_not_scaled_again(call, clip, script):
    command = ("run", clip, *BOX, "--object-size", SIZE, "--out", "metric")
    call(*command)
    before = Path("metric/frames.jsonl").read_bytes()
    assert call(*command, "--resume").exit_code == 0
    assert Path("metric/frames.jsonl").read_bytes() == before


def test_a_finished_run_is_put_into_metres_by_model(call, finished):
    depth = RunReader(finished).frames[0].T_cam_obj[2, 3]
    side = visible_side(load_model(finished))
    result = call("model", finished, "--model", "none", "--object-size", SIZE)
    assert result.exit_code == 0, result.output
    assert "in metres" in result.stdout
    run = RunReader(finished)
    assert run.unit == "metre" and visible_side(load_model(finished)) == pytest.approx(SIZE)
    assert run.frames[0].T_cam_obj[2, 3] == pytest.approx(depth * SIZE / side)


def test_points_are_printed_in_metres_and_the_run_stays_as_it_is(call, finished):
    files = {path: path.read_bytes() for path in finished.glob("*") if path.is_file()}
    query = ("points", finished, "--xy", "31.5,23.5", "--by-mesh")
    plain, metric = (
        next(iter(csv.DictReader(io.StringIO(call(*query, *size).stdout))))
        for size in ((), ("--object-size", SIZE))
    )
    scale = SIZE / visible_side(load_model(finished))
    for axis in "XYZ":
        assert float(metric[axis]) == pytest.approx(float(plain[axis]) * scale, abs=1e-5)
    assert (metric["x"], metric["y"]) == (plain["x"], plain["y"])
    assert {path: path.read_bytes() for path in files} == files


def test_an_export_of_a_metric_run_is_metric_without_the_option(call, clip, script):
    call("run", clip, *BOX, "--object-size", SIZE, "--out", "metric")
    done = json.loads(call("export", "metric", "--to", "glb", "--json").stdout)
    assert done["unit"] == "metre" and unit_in_glb(Path(done["path"])) == {"unit": "metre"}
    other = json.loads(
        call("export", "metric", "--to", "glb", "--object-size", 2, "--out", "b.glb", "--json").stdout
    )
    assert other["unit"] == "metre"


@pytest.mark.parametrize(
    "command", [("run", "clip", *BOX), ("model", "run"), ("points", "run"), ("export", "run", "--to", "glb")]
)
@pytest.mark.parametrize("size", ["0", "-1", "nan", "inf", "1e+07"])
def test_what_is_no_size_is_refused_before_anything_is_read(refused, command, size):
    assert f"--object-size is {size}; give a number of metres above 0" in refused(
        *command, "--object-size", size
    )


def test_a_known_object_has_its_own_unit(refused, clip, finished):
    line = refused("run", clip, "--object", finished, "--object-size", SIZE, "--out", "other")
    assert "has its own unit; leave out --object-size" in line


def test_a_run_that_is_not_finished_keeps_its_unit(call, refused, finished):
    file = finished / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"state": "interrupted"}))
    before = (finished / "frames.jsonl").read_bytes()
    result = call("model", finished, "--model", "none", "--object-size", SIZE)
    assert result.exit_code == 2 and "resume it" in result.stderr
    assert (finished / "frames.jsonl").read_bytes() == before
    assert not np.isnan(RunReader(finished).frames[0].T_cam_obj).any()
