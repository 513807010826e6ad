"""Points followed by a run's mesh and poses, against rays met with a box and a sphere by formula."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.results.correspondences import (
    PointTracks,
    points_to_csv,
    points_to_json,
    surface_under,
    track_points,
)
from tracking3d.results.description import RunHeader
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_writer import RunWriter

CAMERA = Camera(200.0, 210.0, 75.0, 62.0, 160, 120)
HALF = np.array([0.9, 0.5, 0.7])  # of the box


def box_model(
    half: NDArray[np.float64] = HALF, centre: tuple[float, float, float] = (0, 0, 0)
) -> ObjectModel:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + centre
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
    return model_of(corners, faces)


def model_of(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> ObjectModel:
    uvs = np.random.default_rng(0).random((len(faces), 3, 2))
    texture = np.zeros((8, 8, 3), dtype=np.uint8)
    return ObjectModel(
        vertices, faces, uvs, texture, np.ones((8, 8), np.float32), np.zeros((8, 8, 1), np.float32)
    )


def poses(count: int = 12, step: float = 20.0) -> list[NDArray[np.float64]]:
    """Turning on the spot, then leaving the frame to the right."""
    result = []
    for index in range(count):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xy", [25.0, 10.0 + step * index], degrees=True).as_matrix()
        T[:3, 3] = (0.15 * max(index - 6, 0), 0.05, 5.0)
        result.append(T)
    return result


def run_of(
    folder: Path, model: ObjectModel, Ts: list[NDArray[np.float64]], **changes: dict[int, Any]
) -> RunReader:
    """A finished run; ``changes`` maps a field of the estimate to its value in some frames."""
    mask = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    header = RunHeader(config={}, camera=CAMERA, source="", seed=0, fps=None, command=None)
    with RunWriter(folder, header) as writer:
        for index, T in enumerate(Ts):
            estimate = FrameEstimate(10 + index, None, T, mask, None, Status.TRACKED, "", 1.0)
            some = {field: values[index] for field, values in changes.items() if index in values}
            writer.write(dataclasses.replace(estimate, **some), Frame(10 + index, image))
        writer.finish(model, "finished")
    return RunReader(folder)


def rays(T: NDArray[np.float64], xy: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The eye ``(3,)`` and the directions ``(N, 3)`` of the pixels' rays, in object coordinates."""
    ahead = np.column_stack([(xy - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(xy))])
    return -T[:3, :3].T @ T[:3, 3], ahead @ T[:3, :3]


def true_tracks(
    points: NDArray[np.float64], normals: NDArray[np.float64], Ts: list[NDArray[np.float64]]
) -> Any:
    """Positions and visibility of points on a convex surface."""
    seen = np.stack([points @ T[:3, :3].T + T[:3, 3] for T in Ts])
    positions = seen[..., :2] / seen[..., 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    facing = np.stack([((-T[:3, :3].T @ T[:3, 3] - points) * normals).sum(1) > 0 for T in Ts])
    inside = ((positions > -0.5) & (positions < [CAMERA.width - 0.5, CAMERA.height - 0.5])).all(2)
    return positions, facing & inside


def pixels(count: int = 400) -> NDArray[np.float64]:
    """Points between pixel centres all over the frame."""
    return np.random.default_rng(1).uniform(
        (-0.5, -0.5), (CAMERA.width - 0.5, CAMERA.height - 0.5), (count, 2)
    )


def test_points_of_a_turning_box_are_where_geometry_says(tmp_path):
    Ts, xy = poses(), pixels()
    run = run_of(tmp_path, box_model(), Ts)
    for asked in (0, 5):
        tracks = track_points(run, 10 + asked, xy)
        eye, direction = rays(Ts[asked], xy)
        near, far = np.sort(np.stack([(-HALF - eye) / direction, (HALF - eye) / direction]), axis=0)
        enter, axis = near.max(1), near.argmax(1)
        hit = enter < far.min(1)
        assert np.array_equal(tracks.on_object, hit)
        assert 50 < hit.sum() < 350
        points = (eye + enter[:, None] * direction)[hit]
        normals = -np.sign(direction[hit]) * np.eye(3)[axis[hit]]
        positions, visible = true_tracks(points, normals, Ts)
        assert np.array_equal(tracks.frames, 10 + np.arange(12))
        assert np.allclose(tracks.positions[:, hit], positions, atol=1e-4)
        assert np.allclose(tracks.positions[asked, hit], xy[hit], atol=1e-6)
        assert np.isnan(tracks.positions[:, ~hit]).all()
        assert not tracks.visible[:, ~hit].any()
        # Within a pixel of an edge the drawn depth may decide otherwise.
        assert (tracks.visible[:, hit] != visible).mean() < 0.002
        assert tracks.visible[asked, hit].all()
        assert 0.2 < visible.mean() < 0.8


def test_points_of_a_turning_sphere_are_where_geometry_says(tmp_path):
    Ts, xy = poses(), pixels()
    mesh = sphere(11)
    tracks = track_points(run_of(tmp_path, model_of(mesh.vertices, mesh.faces), Ts), 10, xy)
    eye, direction = rays(Ts[0], xy)
    a, b, c = (direction**2).sum(1), direction @ eye, eye @ eye - 1
    hit = b * b - a * c > 0.05  # away from the rim, where the flat faces differ from the sphere
    points = eye + ((-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a)[:, None] * direction
    points = points[hit]
    positions, visible = true_tracks(points, points, Ts)
    assert tracks.on_object[hit].all()
    assert np.abs(tracks.positions[:, hit] - positions).max() < 0.4
    slant = np.stack([((eye_of(T) - points) * points).sum(1) for T in Ts])
    assert np.array_equal(tracks.visible[:, hit][abs(slant) > 0.3], visible[abs(slant) > 0.3])


def eye_of(T: NDArray[np.float64]) -> NDArray[np.float64]:
    return -T[:3, :3].T @ T[:3, 3]


def test_a_point_behind_another_part_of_the_object_is_hidden(tmp_path):
    # A plate with a block in front of it, as one mesh; the camera sees the block slide over the plate.
    plate, block = box_model(np.array([0.8, 0.5, 0.05])), box_model(np.array([0.2, 0.2, 0.05]), (0, 0, -0.8))
    vertices = np.concatenate([plate.vertices, block.vertices])
    model = model_of(vertices, np.concatenate([plate.faces, block.faces + len(plate.vertices)]))
    Ts = []
    for x in (-1.5, 0.0, 1.5):  # at the sides the block is seen before other parts of the plate
        T = np.eye(4)
        T[:3, 3] = (x, 0.0, 5.0)
        Ts.append(T)
    wide = dataclasses.replace(CAMERA, fx=100.0, fy=100.0, cx=79.5, cy=59.5)
    point = np.array([0.3, 0.0, -0.05])
    xy = np.array([wide.fx * (point[0] - 1.5) / (5 + point[2]) + wide.cx, wide.cy])
    assert wide.width == CAMERA.width
    mask = np.ones((120, 160), dtype=bool)
    header = RunHeader(config={}, camera=wide, source="", seed=0, fps=None, command=None)
    with RunWriter(tmp_path, header) as writer:
        for index, T in enumerate(Ts):
            estimate = FrameEstimate(index, None, T, mask, None, Status.TRACKED, "", 1.0)
            writer.write(estimate, Frame(index, np.zeros((120, 160, 3), dtype=np.uint8)))
        writer.finish(model, "finished")
    tracks = track_points(tmp_path, 0, [xy])
    # By the lines of sight through (0.3, 0, -0.05): at z = -0.8 they pass x = 0.57, 0.25 and -0.02.
    sight = [(-T[0, 3]) + (0.3 + T[0, 3]) * (4.2 / 4.95) for T in Ts]
    assert np.allclose(sight, [0.48, 0.25, 0.03], atol=0.01)
    assert tracks.visible[:, 0].tolist() == [abs(x) > 0.2 for x in sight] == [True, True, False]


def test_the_nearest_surface_is_the_one_under_the_pixel():
    front, back = box_model(np.full(3, 0.1), (0, 0, 2)), box_model(np.full(3, 0.5), (0, 0, 5))
    vertices = np.concatenate([back.vertices, front.vertices])
    faces = np.concatenate([back.faces, front.faces + 8])
    screen, depth = vertices[:, :2] / vertices[:, 2:] * 100, vertices[:, 2]
    face, weight = surface_under(screen, depth, faces, np.array([[0.0, 0.0], [8.0, 0.0], [50.0, 0.0]]))
    assert [f // 12 for f in face] == [1, 0, -1]
    points = np.einsum("nk,nkd->nd", weight[:2], vertices[faces[face[:2]]])
    assert np.allclose(points, [[0, 0, 1.9], [0.08 * 4.5, 0, 4.5]])


def test_an_edge_between_two_faces_has_no_gap():
    model = box_model()
    screen, depth = model.vertices[:, :2] * 100, np.full(8, 2.0) + model.vertices[:, 2]
    diagonal = np.linspace(-0.99, 0.99, 101)[:, None] * screen[[4]]  # along the edge the two triangles share
    other = np.linspace(-0.99, 0.99, 101)[:, None] * screen[[0]]
    assert (surface_under(screen, depth, model.faces, np.concatenate([diagonal, other]))[0] >= 0).all()


def test_points_are_not_visible_where_the_object_is_lost_or_its_mask_empty(tmp_path):
    empty = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
    Ts = [poses()[0]] * 5
    nowhere, behind = np.full((4, 4), np.nan), np.eye(4)
    behind[2, 3] = -5.0
    run = run_of(
        tmp_path,
        box_model(),
        Ts,
        status={1: Status.LOST},
        mask={2: empty},
        T_cam_obj={3: nowhere, 4: behind},
    )
    tracks = track_points(run, 10, [[75, 62]])
    assert tracks.visible[:, 0].tolist() == [True, False, False, False, False]
    assert np.allclose(tracks.positions[:3, 0], [75, 62])
    assert np.isnan(tracks.positions[3:]).all()
    with pytest.raises(InputError, match="lost in frame 11"):
        track_points(run, 11, [[75, 62]])
    with pytest.raises(InputError, match="lost in frame 13"):
        track_points(run, 13, [[75, 62]])


def test_pixels_off_the_object_or_outside_the_frame_have_no_track(tmp_path):
    close = poses()[0]
    close[2, 3] = 1.6  # the box reaches beyond the frame
    tracks = track_points(run_of(tmp_path, box_model(), [close, poses()[0]]), 11, [[1, 1], [75, 62]])
    assert tracks.on_object.tolist() == [False, True]
    tracks = track_points(tmp_path, 10, [[75, 62], [159.4, 62], [159.6, 62], [-0.6, 62], [75, 1e9]])
    assert tracks.on_object.tolist() == [True, True, False, False, False]
    assert tracks.face[2:].tolist() == [-1, -1, -1]
    assert np.isnan(tracks.barycentric[2:]).all()
    assert np.allclose(tracks.barycentric[:2].sum(1), 1)


@pytest.mark.parametrize("xy", [[1, 2], [[1, 2, 3]], [["a", "b"]], [[np.nan, 1]], [[1, 2], [3]], 5])
def test_what_are_no_points_is_said(tmp_path, turning_sphere, xy):
    run_of(tmp_path, box_model(), poses(1))
    with pytest.raises(InputError, match="The points"):
        track_points(tmp_path, 10, xy)


def test_a_frame_the_run_does_not_have_is_said(tmp_path):
    run = run_of(tmp_path, box_model(), poses(2))
    with pytest.raises(InputError, match=r"no frame 3; choose one of its frames \(10 to 11\)"):
        track_points(run, 3, [[1, 1]])


def test_no_points_are_no_tracks(tmp_path):
    tracks = track_points(run_of(tmp_path, box_model(), poses(2)), 10, np.zeros((0, 2)))
    assert tracks.positions.shape == (2, 0, 2)


def test_tracks_are_written_as_json_and_csv(tmp_path):
    tracks = track_points(run_of(tmp_path, box_model(), poses(3)), 10, [[75, 62], [1, 1]])
    fields = json.loads(
        points_to_json(tracks), parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )
    assert fields.keys() == {field.name for field in dataclasses.fields(PointTracks)}
    assert fields["on_object"] == [True, False]
    assert fields["frames"] == [10, 11, 12]
    assert fields["positions"][0] == [pytest.approx([75, 62]), [None, None]]
    rows = list(csv.DictReader(io.StringIO(points_to_csv(tracks))))
    assert len(rows) == 6
    assert rows[0] == {
        "frame": "10",
        "point": "0",
        "x": "75.000",
        "y": "62.000",
        "visible": "1",
        "on_object": "1",
        "uncertainty": "",
        "measured": "0",
        "X": f"{tracks.points[0, 0]:.5f}",
        "Y": f"{tracks.points[0, 1]:.5f}",
        "Z": f"{tracks.points[0, 2]:.5f}",
        "kind": "surface",
    }
    unknown = ("x", "y", "uncertainty", "X", "Y", "Z")
    assert rows[1] == {
        "frame": "10",
        "point": "1",
        "visible": "0",
        "on_object": "0",
        "measured": "0",
        "kind": "none",
    } | dict.fromkeys(unknown, "")
