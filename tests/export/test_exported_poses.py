"""Poses as TUM, KITTI, BOP and tables hold them: read back, they give the masks of the run."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.options import ExportOptions
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import longest_side, visible_side
from tracking3d_bench.datasets.pose_files import read_matrix_lines

POSED = [0, 1, 3, 5, 6]
"""Frame 2 is lost, frame 4 was skipped."""


def matrix(translation, w, x, y, z) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    T[:3, 3] = translation
    return T


def check(silhouettes, run, poses: dict[int, np.ndarray]) -> None:
    reader = RunReader(run)
    mesh = reader.mesh()
    assert list(poses) == POSED
    for index, T in poses.items():
        silhouettes(run).agree(index, reader.camera.K, T, mesh.vertices, mesh.faces)


def read_tum(path) -> dict[float, np.ndarray]:
    rows = np.loadtxt(path)  # leaves comments out
    assert rows.shape[1] == 8
    return {row[0]: matrix(row[1:4], row[7], *row[4:7]) for row in rows}


def test_tum_has_a_line_a_pose_at_the_time_of_its_frame(export, run, silhouettes):
    poses = read_tum(export(run, "tum"))
    check(silhouettes, run, {round(25 * time): T for time, T in poses.items()})
    assert list(read_tum(export(run, "tum", "at_50", fps=50.0))) == [index / 50 for index in POSED]


def test_poses_of_the_camera_are_the_inverse(export, run):
    objects, cameras = (read_tum(export(run, "tum", of, of=of)) for of in ("object", "camera"))
    for time, T_obj_cam in cameras.items():
        np.testing.assert_allclose(T_obj_cam @ objects[time], np.eye(4), atol=1e-6)


def test_kitti_has_a_line_a_frame_and_nan_where_there_is_no_pose(export, shifted_run, silhouettes):
    folder = export(shifted_run, "kitti")
    assert np.isnan(np.loadtxt(folder / "poses.txt")).all(1).nonzero()[0].tolist() == [2, 4]
    check(silhouettes, shifted_run, read_matrix_lines(folder / "poses.txt"))
    name, *projection = (folder / "calib.txt").read_text().splitlines()[0].split()
    assert name == "P0:"
    P = np.array(projection, dtype=float).reshape(3, 4)
    np.testing.assert_allclose(P[:, :3], RunReader(shifted_run).camera.K)
    np.testing.assert_allclose(np.loadtxt(folder / "times.txt"), np.arange(7) / 25)


def test_bop_is_in_millimetres(export, run):
    with export(run, "bop").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["im_id"]) for row in rows] == POSED
    for row, record in zip(rows, (one for one in RunReader(run).frames if one.index in POSED), strict=True):
        np.testing.assert_allclose(
            np.array(row["t"].split(), float), 1000 * record.T_cam_obj[:3, 3], rtol=1e-6
        )
        np.testing.assert_allclose(
            np.array(row["R"].split(), float), record.T_cam_obj[:3, :3].ravel(), atol=1e-7
        )
        assert float(row["score"]) == pytest.approx(record.confidence)
        assert float(row["time"]) == pytest.approx(record.seconds, rel=1e-5)


def table_poses(rows) -> dict[int, np.ndarray]:
    found = {}
    for row in rows:
        numbers = [row[name] for name in ("tx", "ty", "tz", "qw", "qx", "qy", "qz")]
        if numbers[0] not in ("", None):
            values = [float(number) for number in numbers]
            found[int(row["index"])] = matrix(values[:3], *values[3:])
    return found


def test_csv_keeps_a_row_without_a_pose_for_a_frame_that_is_lost(export, run, silhouettes):
    with export(run, "csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["index"] for row in rows] == ["0", "1", "2", "3", "5", "6"]
    assert (rows[2]["status"], rows[2]["tx"], rows[2]["name"]) == ("lost", "", "002.png")
    check(silhouettes, run, table_poses(rows))


def test_parquet_is_the_same_table(export, run, silhouettes):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(export(run, "parquet"))
    assert table.schema.metadata[b"unit"] == b"arbitrary"
    rows = table.to_pylist()
    assert rows[2]["tx"] is None
    check(silhouettes, run, table_poses(rows))


def test_a_known_size_makes_lengths_metres(export, run):
    size = longest_side(np.asarray(RunReader(run).mesh().vertices))
    assert size == pytest.approx(1.8, rel=0.02)  # the longest axis of the ellipsoid, however it is turned
    plain, metric = (read_tum(export(run, "tum", f"{s}", object_size=s)) for s in (None, 0.09))
    for time, T in metric.items():
        np.testing.assert_allclose(T[:3, 3], plain[time][:3, 3] * 0.09 / size, atol=1e-8)
        np.testing.assert_allclose(T[:3, :3], plain[time][:3, :3], atol=1e-8)


def test_for_one_lens_a_pose_of_another_keeps_the_place_and_size_of_the_object(
    export, zooming_run, silhouettes
):
    poses = read_matrix_lines(export(zooming_run, "kitti") / "poses.txt")
    reader = RunReader(zooming_run)
    mesh = reader.mesh()
    for index, T in poses.items():
        silhouettes(zooming_run).agree(index, reader.camera.K, T, mesh.vertices, mesh.faces, least=0.94)
    before = reader.frames[0].T_cam_obj
    np.testing.assert_allclose(poses[0][:3, 3], before[:3, 3] * (1, 1, 1 / 0.8), rtol=1e-6)
    np.testing.assert_allclose(poses[5], reader.frames[4].T_cam_obj, atol=1e-6)


def test_a_rate_is_the_one_of_the_source_where_frames_were_selected(run, tmp_path):
    shutil.copytree(run, tmp_path / "every_second")
    file = tmp_path / "every_second" / "run.json"
    described = json.loads(file.read_text())
    file.write_text(json.dumps(described | {"selection": "0:7:2", "fps": 12.5}))
    exported = ExportedRun(RunReader(file.parent), ExportOptions())
    assert exported.known_fps == 25
    assert list(exported.span) == [0, 2, 4, 6]
    file.write_text(json.dumps(described | {"fps": None}))
    assert ExportedRun(RunReader(file.parent), ExportOptions()).fps == 30


def test_only_what_the_video_has_shown_is_measured():
    ball = trimesh.creation.icosphere(3)
    seen = ball.vertices[:, 2] < 0.3  # the camera looks along z
    deep = ball.vertices * np.where(seen, 1, 4)[:, None]  # a guess
    uvs = np.stack([np.where(seen, 0.25, 0.75), np.full(len(seen), 0.5)], axis=-1)[ball.faces]
    texture = np.zeros((8, 8, 3))
    weight = np.zeros((8, 8), np.float32)
    weight[:, :4] = 1
    model = ObjectModel(deep, ball.faces, uvs, texture.astype(np.uint8), weight, texture)
    assert longest_side(deep) > 4
    assert visible_side(model) == pytest.approx(2, rel=0.02)
    hardly = replace(model, texture_weight=np.zeros_like(weight))
    assert visible_side(hardly) == longest_side(deep)
