"""The first pose and the prototype project onto the first mask, in the unit that everything else assumes."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
import trimesh

from tracking3d.config.models import ObjectConfig
from tracking3d.errors import InputError
from tracking3d.estimation.shape import RADIUS, first_translation, mask_ellipse, prototype_mesh
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.mesh import Mesh
from tracking3d.rendering import project, rasterize
from tracking3d_bench.evaluation.metrics import mask_iou

CAMERA = Camera.from_fov(200, 160)


def drawn_ellipse(centre=(100, 80), semi_axes=(40, 40), angle: float = 0.0) -> np.ndarray:
    canvas = np.zeros((160, 200), np.uint8)
    cv2.ellipse(canvas, centre, semi_axes, angle, 0, 360, 1, -1)
    return canvas.astype(bool)


def projected(mesh: Mesh, translation: np.ndarray, camera: Camera) -> np.ndarray:
    vertices = torch.tensor(mesh.vertices)
    t, K = torch.tensor(translation)[None], torch.tensor(camera.K)[None]
    screen, depth = project(vertices, torch.eye(3, dtype=torch.float64)[None], t, K)
    visibility = rasterize(screen, depth, torch.tensor(mesh.faces), (camera.height, camera.width))
    return visibility.face_index[0].numpy() >= 0


def started(mask: np.ndarray, prototype: str, camera: Camera = CAMERA) -> tuple[Mesh, np.ndarray]:
    ellipse = mask_ellipse(mask)
    mesh = prototype_mesh(ObjectConfig(prototype=prototype), ellipse)
    return mesh, projected(mesh, first_translation(ellipse, camera), camera)


def test_the_ellipse_of_a_mask_is_the_one_that_was_drawn():
    ellipse = mask_ellipse(drawn_ellipse((90, 70), (50, 20), 30))
    np.testing.assert_allclose(ellipse.centre, [90, 70], atol=0.5)
    np.testing.assert_allclose(ellipse.semi_axes, [50, 20], atol=1)
    along = ellipse.directions[:, 0]
    assert abs(along @ [math.cos(math.radians(30)), math.sin(math.radians(30))]) > 0.999
    np.testing.assert_allclose(ellipse.directions.T @ ellipse.directions, np.eye(2), atol=1e-12)


@pytest.mark.parametrize("rows", [slice(5, 6), slice(5, 25)])
def test_a_mask_of_one_pixel_or_one_line_has_an_ellipse_of_some_width(rows):
    mask = np.zeros((30, 30), bool)
    mask[rows, 7] = True
    ellipse = mask_ellipse(mask)
    assert (ellipse.semi_axes >= 0.5).all()
    assert np.isfinite(first_translation(ellipse, CAMERA)).all()


@pytest.mark.parametrize("prototype", ["sphere", "ellipsoid"])
@pytest.mark.parametrize("centre", [(100, 80), (50, 50), (150, 110)])
@pytest.mark.parametrize("radius", [12, 30, 60])
def test_prototype_projects_onto_a_disc(prototype, centre, radius):
    mask = drawn_ellipse(centre, (radius, radius))
    mesh, silhouette = started(mask, prototype)
    assert mask_iou(silhouette, mask) > 0.9
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(RADIUS, rel=0.02)


@pytest.mark.parametrize("angle", [0, 30, 90, 135])
@pytest.mark.parametrize("semi_axes", [(50, 35), (50, 17)])
def test_ellipsoid_projects_onto_an_ellipse(semi_axes, angle):
    mask = drawn_ellipse((110, 75), semi_axes, angle)
    mesh, silhouette = started(mask, "ellipsoid")
    assert mask_iou(silhouette, mask) > 0.9
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(RADIUS, rel=0.02)


def test_ellipsoid_is_as_deep_as_the_geometric_mean_of_what_is_seen():
    mesh, _ = started(drawn_ellipse(semi_axes=(50, 25)), "ellipsoid")
    extent = np.abs(mesh.vertices).max(0)
    np.testing.assert_allclose(extent, [RADIUS, RADIUS / 2, RADIUS / math.sqrt(2)], rtol=0.05)


def test_sphere_covers_as_much_of_an_ellipse_as_the_mask_does():
    mask = drawn_ellipse(semi_axes=(50, 35))
    _, silhouette = started(mask, "sphere")
    assert silhouette.sum() == pytest.approx(mask.sum(), rel=0.08)


def test_start_takes_slightly_oblong_pixels_and_a_shifted_principal_point():
    camera = Camera(240.0, 220.0, 70.0, 100.0, 200, 160)
    truth = np.array([0.2, -0.4, 3.5])
    mesh = prototype_mesh(ObjectConfig(), mask_ellipse(drawn_ellipse()))
    mask = projected(mesh, truth, camera)
    _, silhouette = started(mask, "ellipsoid", camera)
    assert mask_iou(silhouette, mask) > 0.9


def test_a_sphere_that_is_seen_is_put_back_where_it_is():
    mesh = prototype_mesh(ObjectConfig(), mask_ellipse(drawn_ellipse()))
    mesh = Mesh(
        mesh.vertices / np.linalg.norm(mesh.vertices, axis=1).max() * RADIUS, mesh.faces, mesh.face_uvs
    )
    truth = np.array([0.1, 0.05, 3.0])
    found = first_translation(mask_ellipse(projected(mesh, truth, CAMERA)), CAMERA)
    np.testing.assert_allclose(found, truth, rtol=0.02, atol=0.02)


def test_faces_of_every_prototype_look_outwards(tmp_path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.ply")
    for prototype in ("sphere", "ellipsoid", str(tmp_path / "box.ply")):
        mesh, _ = started(drawn_ellipse(semi_axes=(50, 20), angle=40), prototype)
        assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0


def test_a_mesh_file_is_brought_to_the_same_unit(tmp_path):
    trimesh.creation.box((10, 20, 30)).apply_translation([500, 0, 0]).export(tmp_path / "box.obj")
    mesh, _ = started(drawn_ellipse(), str(tmp_path / "box.obj"))
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(RADIUS)
    extent = np.ptp(mesh.vertices, axis=0)
    np.testing.assert_allclose(extent / extent[0], [1, 2, 3], rtol=1e-6)


def test_a_prototype_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match=r"nowhere\.obj"):
        started(drawn_ellipse(), "nowhere.obj")
