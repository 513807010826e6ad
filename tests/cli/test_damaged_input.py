"""What cannot be used ends with exit code 2 and one sentence, and is never taken without a word."""

from __future__ import annotations

import csv
import io
import json
import math
import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from recorded_runs import HEIGHT, WIDTH, write_run

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.geometry.alignment import is_rigid
from tracking3d.geometry.camera import Camera
from tracking3d.plugins.guard import GuardedTracker, PluginFailure
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import write_clip
from tracking3d.ui.viewer.followed_run import FollowedRun

LONG = "x" * 300
BOX = ("--box", "20,10,20,20")
ZEROS, UNKNOWN = np.zeros((4, 4)).tolist(), np.full((4, 4), math.nan).tolist()


@pytest.fixture
def run(tmp_path) -> Path:
    return write_run(tmp_path / "run", 3)


def change_poses(run: Path, T: list) -> None:
    path = run / "frames.jsonl"
    records = [json.loads(line) | {"T_cam_obj": T} for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps(record) + "\n" for record in records))


def change_masks(run: Path) -> None:
    for file in (run / "masks").glob("*.png"):
        Image.fromarray(np.full((20, 30), 255, np.uint8)).save(file)


def change_model(run: Path, **changes: Callable[[np.ndarray], np.ndarray]) -> None:
    path = run / "features.npz"
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays | {name: change(arrays[name]) for name, change in changes.items()})


def with_first(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array.flat[0] = value
        return array

    return change


@pytest.mark.usefixtures("script")
@pytest.mark.parametrize("more", [(), ("--resume",), ("--overwrite",)])
def test_a_run_folder_with_too_long_a_name(refused, clip, more):
    line = refused("run", clip, *BOX, "--out", LONG, "--quiet", *more)
    assert line.endswith("... is too long for the name of a file or folder; choose a shorter one.")


def test_an_export_with_too_long_a_name(refused, run):
    assert "is too long for the name" in refused("export", run, "--to", "tum", "--out", LONG)


@pytest.mark.parametrize("mirror", ["http://[", "http://", "https://host:port", "https://[::1/networks"])
def test_a_mirror_that_is_no_address(refused, mirror):
    assert f"The mirror {mirror} is not an address" in refused("models", "get", "u2netp", "--mirror", mirror)


def test_a_deeply_nested_progress_file(refused, tmp_path):
    (tmp_path / "progress.json").write_text("[" * 100_000)
    assert "progress.json is damaged" in refused("batch", "status", tmp_path)


def test_poses_of_zeros_in_the_viewer(run):
    change_poses(run, UNKNOWN)
    FollowedRun(run, "run").look_again()  # an estimate that is not a number is part of a run
    change_poses(run, ZEROS)
    with pytest.raises(InputError, match=r"frames\.jsonl is damaged \(the pose of frame 0 is not a rotation"):
        FollowedRun(run, "run").look_again()


@pytest.mark.parametrize(
    "command", [("export", "run", "--to", "tum"), ("report", "run"), ("points", "run", "--xy", "40,30")]
)
def test_a_pose_that_is_no_rotation_is_named_by_every_command(call, run, command):
    change_poses(run, np.diag([1.0, 1, 1.05, 1]).tolist())
    result = call(*command)
    assert result.exit_code == 2 and "the pose of frame 0 is not a rotation" in result.stderr


def test_poses_that_are_nearly_rotations_are_used_with_one_note(run, caplog):
    change_poses(run, np.diag([1.0, 1, 1.005, 1]).tolist())
    for _ in range(2):
        assert all(is_rigid(record.T_cam_obj, 1e-9) for record in RunReader(run).frames)
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    "command",
    [
        ("points", "--frame", "0", "--xy", "40,30"),
        *(
            ("export", "--to", name, "--out", "export")
            for name in ("coco", "vot", "davis", "cut-outs", "colmap")
        ),
    ],
    ids=" ".join,
)
def test_masks_of_another_size(call, run, command):
    change_masks(run)
    result = call(command[0], run, *command[1:])
    assert result.exit_code == 2, result.output
    assert result.stderr.splitlines()[-1].endswith(
        f".png is 30 x 20 pixels, but the frames of the run are {WIDTH} x {HEIGHT}; restore it."
    )
    assert not Path("export").exists()


def write_png_of(size: int, path: Path) -> None:
    """An image of ``size`` x ``size`` pixels, as its header says; of its content there is one row."""
    header = struct.pack(">2I5B", size, size, 8, 0, 0, 0, 0)
    chunks = {b"IHDR": header, b"IDAT": zlib.compress(bytes(size + 1)), b"IEND": b""}
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            for kind, data in chunks.items()
        )
    )


def test_a_mask_of_more_pixels_than_can_be_decoded(refused, run):
    write_png_of(40_000, run / "masks" / "000000.png")
    line = refused("export", run, "--to", "coco")
    assert line.endswith("has no mask of frame 0; 000000.png is missing or damaged.")


@pytest.mark.parametrize("to", ["ply", "stl", "glb", "animated-glb", "blender", "nuke"])
@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"faces": with_first(99_999)}, "has faces with missing vertices"),
        ({"faces": with_first(-1)}, "has faces with missing vertices"),
        ({"vertices": with_first(math.nan)}, "has vertices with invalid coordinates"),
        ({"vertices": with_first(math.inf)}, "has vertices with invalid coordinates"),
        ({"face_uvs": with_first(math.nan)}, "has texture coordinates that are not finite"),
        ({"faces": lambda faces: faces[:, :2]}, "has no faces"),
    ],
    ids=["beyond", "negative", "nan", "infinite", "uvs", "edges"],
)
def test_a_mesh_that_is_no_surface(refused, run, to, changes, fault):
    change_model(run, **changes)
    assert fault in refused("export", run, "--to", to, "--out", "export")
    assert not Path("export").exists()


UNPRINTABLE = """
from pydantic import BaseModel

class Unprintable(Exception):
    def __str__(self):
        raise RuntimeError("no text")

class Tracker:
    class Options(BaseModel):
        pass

    @classmethod
    def from_options(cls, options):
        raise {error}

    def init(self, frame, prompt):
        raise {error}

    def step(self, frame):
        raise {error}
{at_import}
"""


@pytest.mark.usefixtures("script")
@pytest.mark.parametrize("at_import", [False, True])
@pytest.mark.parametrize("error", ["Unprintable", "GeneratorExit"])
def test_a_plugin_that_raises_what_cannot_be_printed_or_is_no_exception(
    refused, clip, monkeypatch, tmp_path, error, at_import
):
    file = tmp_path / f"{error}_{at_import}.py"
    file.write_text(UNPRINTABLE.format(error=error, at_import=f"raise {error}" if at_import else ""))
    monkeypatch.setenv("TRACKING3D_PLUGINS", f"tracking3d.trackers:odd={file}:Tracker")
    line = refused("run", clip, *BOX, "--tracker", "odd", "--out", "out", "--quiet")
    assert "mask tracker 'odd'" in line and error in line


class UnprintableError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")


@pytest.mark.parametrize("error", [UnprintableError(), GeneratorExit()])
def test_a_plugin_that_raises_it_in_a_frame_has_failed_there(error):
    class Tracker:
        def init(self, frame, prompt):
            raise error

    frame = Frame(0, np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(PluginFailure, match=type(error).__name__):
        GuardedTracker(Tracker(), "it").init(frame, Prompt((0, 0, 2, 2)))


def test_an_error_of_our_own_that_cannot_be_printed(call, monkeypatch, run):
    def fail(*arguments, **named):
        raise UnprintableError

    monkeypatch.setattr("tracking3d.export.exporting.export_run", fail)
    result = call("export", run, "--to", "tum")
    assert result.exit_code == 1
    assert "UnprintableError: it cannot be printed" in result.stderr


# What was taken without a word.


@pytest.mark.usefixtures("script")
@pytest.mark.parametrize(
    "given", [("--masks", "regions.txt"), ("--box", "regions.txt")], ids=lambda given: given[0]
)
def test_rectangles_with_a_negative_side(refused, clip, given):
    Path("regions.txt").write_text("20,10,20,20\n20,10,20,20\n40,30,-20,-20\n")
    line = refused("run", clip, *given, "--out", "out", "--quiet")
    assert "regions.txt, line 3: the rectangle 40,30,-20,-20 has a negative width or height; " in line
    assert not Path("out").exists()


def test_a_table_with_a_column_twice(refused):
    Path("videos.csv").write_text('video,box,box\na.mp4,"1,2,3,4","5,6,7,8"\n')
    assert "videos.csv cannot be read (it has two columns box; remove one)" in refused(
        "batch", "videos.csv", "--out", "runs"
    )


def test_sequences_of_a_table(refused):
    Path("videos.csv").write_text('video,box\na.mp4,"1,2,3,4"\n')
    assert "--sequence names sequences of a dataset; give its folder with --data" in refused(
        "batch", "videos.csv", "--out", "runs", "--sequence", "a"
    )


@pytest.fixture
def truth(tmp_path) -> Path:
    folder = tmp_path / "truth"
    images, masks = [np.zeros((48, 64, 3), np.uint8)] * 3, [np.ones((48, 64), bool)] * 3
    write_clip(folder, images, masks, [np.eye(4)] * 3, Camera.from_fov(64, 48), source="a test", note="")
    np.savez(folder / "points.npz", positions=np.full((3, 2, 2), 20.0), visible=np.ones((3, 2), bool))
    return folder


def tapvid(path: Path, tracks: np.ndarray) -> Path:
    arrays = {"tracks": tracks, "occluded": np.zeros(tracks.shape[:2], bool)}
    path.write_bytes(pickle.dumps(arrays))
    return path


@pytest.mark.parametrize(
    ("tracks", "what"),
    [
        (np.full((2, 3, 2), math.inf), "no track with a finite position"),
        (np.full((2, 3, 2), math.nan), "no track with a finite position"),
        (np.zeros((0, 3, 2)), "no tracks"),
    ],
    ids=["infinite", "nan", "none"],
)
def test_point_tracks_without_a_position(refused, truth, tracks, what):
    file = tapvid(Path("tracks.pkl"), tracks)
    assert f"tracks.pkl has {what}, so there is nothing to score" in refused(
        "evaluate", file, "--truth", truth
    )


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ("raster=256,256,3", "The option raster of TAP-Vid point tracks cannot be '256,256,3'"),
        ("raster=wide", "The option raster of TAP-Vid point tracks cannot be 'wide'"),
        ("raster=0,0", "A raster of 0 x 0 has no size"),
        ("name=[1]", "The option name of TAP-Vid point tracks cannot be [1]: it must be a valid string"),
        ("rastre=256,256", "has no such option (rastre); did you mean 'raster'?"),
    ],
)
def test_an_option_of_results_of_the_wrong_kind(refused, truth, option, sentence):
    file = tapvid(Path("tracks.pkl"), np.full((2, 3, 2), 100.0))
    assert sentence in refused("evaluate", file, "--truth", truth, "--option", option)


@pytest.mark.parametrize("raster", ["256,256", "[256, 256]"])
def test_a_raster_is_two_numbers(call, truth, raster):
    file = tapvid(Path("tracks.pkl"), np.full((2, 3, 2), 82.0))
    result = call("evaluate", file, "--truth", truth, "--option", f"raster={raster}", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["points_delta_average"] is not None


@pytest.mark.parametrize("column", ["R", "t"])
def test_results_of_the_bop_challenge_that_are_not_numbers(refused, truth, column):
    row = {
        "scene_id": 1,
        "im_id": 0,
        "obj_id": 1,
        "score": 1,
        "R": "1 0 0 0 1 0 0 0 1",
        "t": "0 0 900",
        "time": 1,
    }
    row[column] = " ".join(["nan", *row[column].split()[1:]])
    text = io.StringIO()
    writer = csv.DictWriter(text, list(row))
    writer.writeheader()
    writer.writerow(row)
    Path("results.csv").write_text(text.getvalue())
    line = refused("evaluate", "results.csv", "--truth", truth)
    assert "Line 2 of results.csv has a pose with values that are not finite; remove it." in line
