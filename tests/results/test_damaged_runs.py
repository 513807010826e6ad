"""Run folders that somebody damaged: every reader says in one sentence which file, and of frames which line."""

from __future__ import annotations

import json
import shutil

import pytest

from tracking3d.errors import InputError
from tracking3d.results.correspondences import track_points
from tracking3d.results.run_reader import RunReader
from tracking3d_bench.datasets.run_answers import answers_of_run
from tracking3d_bench.datasets.truth import Truth


def read_everything(folder):
    """All that the commands read of a run."""
    run = RunReader(folder)
    _ = run.camera, run.config, run.state
    for record in run.frames:
        run.mask(record.index)
    estimates = answers_of_run(folder, Truth("clip", tuple(folder / f"{n}.png" for n in range(8))))
    assert estimates.mesh is not None
    estimates.mesh()
    track_points(run, 0, [[50, 60]])


@pytest.fixture(scope="module")
def sound_run(tmp_path_factory, turning_sphere, write_run):
    folder = tmp_path_factory.mktemp("sound") / "run"
    write_run(folder, turning_sphere)
    read_everything(folder)
    return folder


@pytest.fixture
def run(tmp_path, sound_run):
    return shutil.copytree(sound_run, tmp_path / "run")


def said(folder):
    with pytest.raises(InputError) as error:
        read_everything(folder)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("index", "x"),
        ("index", -1),
        ("index", 10**30),
        ("index", 1.5),
        ("index", True),
        ("time", "early"),
        ("name", 5),
        ("T_cam_obj", "pose"),
        ("T_cam_obj", [[1, 2], [3, 4]]),
        ("T_cam_obj", [["a"] * 4] * 4),
        ("T_cam_obj", None),
        ("status", "happy"),
        ("status", []),
        ("reason", None),
        ("confidence", "high"),
        ("losses", [1]),
        ("losses", {"features": "small"}),
        ("iterations", None),
        ("keyframe", "yes"),
        ("seconds", "long"),
        ("iou_initial", {}),
        ("area", "large"),
        ("revision", 2),
        ("refined", "no"),
        ("stages", [1, 2]),
        ("stages", {"sleep": 1}),
        ("stages", {"track": "long"}),
        ("mask_source", "elsewhere"),
    ],
)
def test_a_wrong_value_in_a_frame_is_named_with_its_line(run, key, value):
    lines = (run / "frames.jsonl").read_text().splitlines()
    lines[2] = json.dumps(json.loads(lines[2]) | {key: value})
    (run / "frames.jsonl").write_text("\n".join(lines) + "\n")
    assert said(run).startswith(f"Line 3 of {run / 'frames.jsonl'} is damaged")


@pytest.mark.parametrize("key", ["index", "T_cam_obj", "status", "area"])
def test_a_frame_that_lacks_something_is_named_with_its_line(run, key):
    lines = (run / "frames.jsonl").read_text().splitlines()
    fields = json.loads(lines[-1])
    del fields[key]
    (run / "frames.jsonl").write_text("\n".join([*lines[:-1], json.dumps(fields)]) + "\n")
    assert "Line 8 of" in said(run)
    assert f"{key} is missing" in said(run)


@pytest.mark.parametrize(
    "content",
    [
        bytes(range(256)) * 50,
        b"\0" * 3_000_000,
        b"null\n",
        b"[" * 100_000 + b"\n",
        b'"text"',
        b"\xff\xfe{}\n",
    ],
    ids=["binary", "zeros", "null", "deep", "text", "utf-16"],
)
def test_frames_that_are_no_text_of_ours_are_named(run, content):
    (run / "frames.jsonl").write_bytes(content)
    assert said(run).startswith(f"Line 1 of {run / 'frames.jsonl'} is damaged")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", "x"),
        ("height", 10**30),
        ("height", 0),
        ("width", 64.5),
        ("fx", -3),
        ("fy", None),
        ("cx", 1e300),
        ("cy", "left"),
        ("origin", 7),
        ("focal_deviation", "small"),
        ("focal_deviation", -0.1),
        ("assumed", "no"),
        ("zoom", 3),
    ],
)
def test_a_camera_that_cannot_be_is_named(run, key, value):
    description = json.loads((run / "run.json").read_text())
    description["camera"][key] = value
    (run / "run.json").write_text(json.dumps(description))
    assert f"{run / 'run.json'} is damaged: it names no camera" in said(run)
    assert key in said(run)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("camera", 5),
        ("camera", {}),
        ("config", []),
        ("state", None),
        ("selection", 7),
        ("refinement", "done"),
        ("counts", [1]),
        ("timings", "long"),
        ("notes", {}),
        ("skipped", 0),
    ],
)
def test_a_wrong_value_in_the_description_is_named(run, key, value):
    description = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(description | {key: value}))
    assert said(run).startswith(f"{run / 'run.json'} is damaged")


def test_a_description_that_was_cut_off_or_nested_is_named(run):
    whole = (run / "run.json").read_bytes()
    for content in (whole[:200], b"[" * 100_000, bytes(range(256))):
        (run / "run.json").write_bytes(content)
        assert said(run).startswith(f"{run / 'run.json'} is damaged")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
        b"v 0 0 0\nv 1e300 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v x y z\nf 1 2 3\n",
        bytes(range(256)),
    ],
    ids=["empty", "points", "missing vertex", "huge", "nan", "words", "binary"],
)
def test_a_mesh_that_is_no_surface_is_named(run, content):
    (run / "mesh.obj").write_bytes(content)
    assert said(run).startswith(f"The mesh {run / 'mesh.obj'} ")


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n"])
def test_a_mask_that_is_no_picture_is_named(run, content):
    (run / "masks" / "000003.png").write_bytes(content)
    assert "has no mask of frame 3; 000003.png is missing or damaged" in said(run)
