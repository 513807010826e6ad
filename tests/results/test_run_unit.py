"""A run whose object was measured has all its lengths in metres; what is not a length stays as it is."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from turning_sphere import started_run, written_run

from tracking3d.config.models import ObjectConfig
from tracking3d.errors import InputError, OutputError
from tracking3d.results import layout, run_unit
from tracking3d.results.correspondences import track_points
from tracking3d.results.mesh_export import export_mesh, load_model
from tracking3d.results.point_tracking import read_landmarks, write_landmarks
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.results.run_unit import apply_object_size, scale_run, visible_side

METRES = 0.22


@pytest.fixture
def run(tmp_path, turning_sphere) -> Path:
    written_run(tmp_path / "run", turning_sphere)
    return tmp_path / "run"


@pytest.fixture
def refined_run(tmp_path, turning_sphere) -> Path:
    """A run whose refined surface and poses are half as large as the causal ones."""
    folder = tmp_path / "refined"
    half = replace(turning_sphere.model, vertices=turning_sphere.model.vertices * 0.5)
    written_run(folder, turning_sphere)
    (folder / layout.CAUSAL).mkdir()
    export_mesh(folder / layout.CAUSAL, turning_sphere.model)
    export_mesh(folder, half)
    lines = (folder / layout.FRAMES).read_text().splitlines()
    with (folder / layout.FRAMES).open("a") as file:
        for record in map(json.loads, lines):
            T = np.array(record["T_cam_obj"])
            T[:3, 3] *= 0.5
            file.write(
                json.dumps(record | {"T_cam_obj": T.tolist(), "refined": True, "revision": True}) + "\n"
            )
    return folder


def depths(run: Path, refined: bool = True) -> list[float]:
    return [record.T_cam_obj[2, 3] for record in RunReader(run, refined).frames]


def test_poses_and_mesh_are_scaled_together_and_run_json_says_so(run, turning_sphere):
    before = RunReader(run)
    rotations = [record.T_cam_obj[:3, :3] for record in before.frames]
    mask = before.mask(0)
    assert before.unit == "arbitrary" and before.description["unit"] == {"name": "arbitrary"}
    scale_run(run, METRES)
    after = RunReader(run)
    assert after.unit == "metre"
    assert after.description["unit"]["object_size"] == METRES
    assert visible_side(load_model(run)) == pytest.approx(METRES)
    scale = after.description["unit"]["scale"]
    assert scale == pytest.approx(METRES / visible_side(turning_sphere.model))
    assert depths(run) == pytest.approx([4 * scale] * 8)
    for record, rotation in zip(after.frames, rotations, strict=True):
        np.testing.assert_array_equal(record.T_cam_obj[:3, :3], rotation)
    np.testing.assert_array_equal(after.mask(0), mask)
    np.testing.assert_allclose(after.mesh().vertices.max(), load_model(run).vertices.max(), rtol=1e-6)


def test_what_is_seen_stays_where_it_is_in_the_image(run):
    pixels = [(60.0, 60.0), (80.0, 50.0)]
    before = track_points(RunReader(run), 2, pixels)
    scale_run(run, METRES)
    after = track_points(RunReader(run), 2, pixels)
    np.testing.assert_allclose(after.positions, before.positions, atol=1e-3)
    scale = RunReader(run).description["unit"]["scale"]
    np.testing.assert_allclose(after.points, before.points * scale, rtol=1e-4)


def test_counts_names_and_times_are_those_of_the_run_before(run):
    before = [replace(record, T_cam_obj=None) for record in RunReader(run).frames]
    scale_run(run, METRES)
    assert [vars(replace(one, T_cam_obj=None)) for one in RunReader(run).frames] == [
        vars(one) for one in before
    ]


def test_causal_and_refined_estimates_are_scaled_each_by_its_own_mesh(refined_run):
    scale_run(refined_run, METRES)
    for refined in (True, False):
        assert visible_side(load_model(RunReader(refined_run, refined).mesh_folder)) == pytest.approx(METRES)
    unit = RunReader(refined_run).description["unit"]
    assert unit["scale"] == pytest.approx(2 * unit["causal_scale"])
    assert depths(refined_run) == pytest.approx(depths(refined_run, refined=False))
    assert all(record.refined for record in RunReader(refined_run).frames)


def test_lines_in_the_own_unit_stay_where_checkpoints_expect_them(run):
    own = (run / layout.FRAMES).read_bytes()
    scale_run(run, METRES)
    scale_run(run, 2 * METRES)
    assert (run / layout.FRAMES).read_bytes().startswith(own)
    assert RunReader(run).description["unit"]["own_lines"] == len(own)
    assert len(list(read_records(run / layout.FRAMES))) == 16  # scaled lines are replaced, not added


def test_a_second_size_counts_and_the_first_leaves_no_trace(run, tmp_path, turning_sphere):
    written_run(tmp_path / "once", turning_sphere)
    scale_run(run, 3.0)
    scale_run(run, METRES)
    scale_run(tmp_path / "once", METRES)
    assert depths(run) == pytest.approx(depths(tmp_path / "once"), rel=1e-12)
    np.testing.assert_allclose(load_model(run).vertices, load_model(tmp_path / "once").vertices, rtol=1e-12)


def test_on_a_full_disk_a_run_stays_whole_in_its_own_unit(run, monkeypatch):
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    write = Path.write_bytes

    def until_the_mesh(self, data):
        if layout.GLB in self.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", until_the_mesh)
        with pytest.raises(OutputError, match="disk is full"):
            scale_run(run, METRES)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    scale_run(run, METRES)
    assert visible_side(load_model(run)) == pytest.approx(METRES)


@pytest.mark.parametrize("killed_at", [0, 1, 2, 5, 9, 12])
def test_a_scaling_that_was_killed_is_completed(refined_run, tmp_path, monkeypatch, killed_at):
    class Killed(BaseException):
        pass

    steps = iter(range(100))

    def until_then(step):
        def call(*arguments):
            if next(steps) == killed_at:
                raise Killed
            return step(*arguments)

        return call

    with monkeypatch.context() as patch:
        patch.setattr(run_unit, "note_in_run", until_then(run_unit.note_in_run))
        patch.setattr(Path, "replace", until_then(Path.replace))
        with pytest.raises(Killed):
            scale_run(refined_run, METRES)
    if json.loads((refined_run / layout.RUN).read_bytes()).get("scaling"):
        with pytest.raises(InputError, match=r"Only some files of .* are in metres"):
            RunReader(refined_run)
    apply_object_size(refined_run, ObjectConfig(size=METRES))
    reader = RunReader(refined_run)
    assert reader.unit == "metre" and not reader.description["scaling"]
    for refined in (True, False):
        assert visible_side(load_model(RunReader(refined_run, refined).mesh_folder)) == pytest.approx(METRES)
    unit = reader.description["unit"]
    assert depths(refined_run) == pytest.approx([2 * unit["scale"]] * 8)
    assert depths(refined_run, refined=False) == pytest.approx([4 * unit["causal_scale"]] * 8)


def test_landmarks_are_scaled_and_still_belong_to_the_run(run):
    reader = RunReader(run)
    poses = np.stack([record.T_cam_obj for record in reader.frames])
    write_landmarks(reader, reader.mesh().vertices * 1.01, poses)
    vertices, _ = read_landmarks(RunReader(run))
    scale_run(run, METRES)
    found = read_landmarks(RunReader(run))
    assert found is not None
    scale = RunReader(run).description["unit"]["scale"]
    np.testing.assert_allclose(found[0], vertices * scale, rtol=1e-9)
    np.testing.assert_allclose(found[1][:, :3, 3], poses[:, :3, 3] * scale, rtol=1e-9)


def test_a_run_is_scaled_once_however_often_it_is_resumed(run):
    for _ in range(2):
        apply_object_size(run, ObjectConfig(size=METRES))
        files = {path: path.read_bytes() for path in run.iterdir() if path.is_file()}
    apply_object_size(run, ObjectConfig(size=METRES))
    assert {path: path.read_bytes() for path in files} == files


def test_without_a_size_nothing_changes(run):
    files = {path: path.read_bytes() for path in run.iterdir() if path.is_file()}
    apply_object_size(run, ObjectConfig())
    assert {path: path.read_bytes() for path in files} == files


def test_a_known_object_brings_its_unit_along(run, tmp_path, turning_sphere):
    scale_run(run, METRES)
    written_run(tmp_path / "other", turning_sphere)
    before = depths(tmp_path / "other")
    apply_object_size(tmp_path / "other", ObjectConfig(model=str(run)))
    other = RunReader(tmp_path / "other")
    assert other.unit == "metre" and other.description["unit"]["object_size"] == METRES
    assert depths(tmp_path / "other") == before


def test_what_cannot_be_scaled_is_refused(run, tmp_path, turning_sphere):
    for size in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="metres above 0"):
            scale_run(run, size)
    assert RunReader(run).unit == "arbitrary"
    with started_run(tmp_path / "half", turning_sphere) as writer:
        writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
        writer.finish(turning_sphere.model, "interrupted")
    with pytest.raises(InputError, match="before it is finished"):
        scale_run(tmp_path / "half", METRES)
    written_run(tmp_path / "bare", turning_sphere, with_model=False)
    with pytest.raises(InputError, match=r"holds no features\.npz"):
        scale_run(tmp_path / "bare", METRES)
