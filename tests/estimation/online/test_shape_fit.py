"""The surface takes the shape that outlines and landmarks show, and no other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from rendered_solids import (
    SIZE,
    box,
    drawn,
    intrinsics,
    mean_iou,
    pose_of,
    poses_around,
    shape_of,
    silhouettes,
)
from scipy import sparse
from scipy.ndimage import map_coordinates
from torch import Tensor

from tracking3d.estimation.online.optimization.shape_fit import (
    FitWeights,
    FloatArray,
    Landmarks,
    Rows,
    ShapeKeyframes,
    _covered_rows,
    _faces_before,
    _outline_rows,
    _solve,
    fit_surface,
)
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import find_contour, signed_distance

USUAL = FitWeights()
BALL = shape_of((0.75, 0.75, 0.75))
ELLIPSOID = shape_of(frequency=10)


def views_of(masks: Tensor, poses: list[Pose], weight: Tensor | None = None) -> ShapeKeyframes:
    batch = Pose.stack(poses)
    K = intrinsics(masks.shape[-1]).repeat(len(poses), 1, 1)
    weight = torch.ones(len(poses)) if weight is None else weight
    return ShapeKeyframes(batch.R, batch.translation, K, signed_distance(masks), weight)


def fitted(
    views: ShapeKeyframes, landmarks: Landmarks | None = None, weights: FitWeights = USUAL, rounds: int = 6
) -> Tensor:
    """The ball, fitted."""
    return fit_surface(
        BALL.rest, BALL.rest, BALL.faces, BALL.face_uvs, BALL.laplacian, views, landmarks, weights, rounds
    )


def solid(name: str) -> tuple[Tensor, Tensor]:
    return box() if name == "box" else (ELLIPSOID.rest, ELLIPSOID.faces)


@pytest.mark.parametrize("name", ["ellipsoid", "box"])
def test_outlines_from_all_around_give_the_silhouettes(name):
    poses, (vertices, faces) = poses_around(), solid(name)
    masks = silhouettes(vertices, faces, poses)
    shape = fitted(views_of(masks, poses))
    before, after = (mean_iou(silhouettes(v, BALL.faces, poses), masks) for v in (BALL.rest, shape))
    assert before < 0.9 and after > 0.97


def test_an_ellipsoid_has_its_axes_afterwards():
    poses = poses_around()
    shape = fitted(views_of(silhouettes(*solid("ellipsoid"), poses), poses))
    assert (shape.amax(0) - torch.tensor([0.9, 0.7, 0.6])).abs().max() < 0.03


def test_views_that_were_not_fitted_agree_too():
    poses = poses_around()
    shape = fitted(views_of(silhouettes(*solid("ellipsoid"), poses), poses))
    others = [pose_of(22 + 45 * n, (0.3, 1, 0)) for n in range(8)]
    assert mean_iou(silhouettes(shape, BALL.faces, others), silhouettes(*solid("ellipsoid"), others)) > 0.96


def test_every_round_brings_the_outlines_nearer():
    poses = poses_around()
    masks = silhouettes(*solid("box"), poses)
    overlap = [
        mean_iou(silhouettes(fitted(views_of(masks, poses), rounds=n), BALL.faces, poses), masks)
        for n in range(4)
    ]
    assert overlap == sorted(overlap) and overlap[1] > overlap[0] + 0.05


def test_the_true_shape_stays():
    poses = poses_around()
    views = views_of(silhouettes(BALL.rest, BALL.faces, poses, 128), poses)
    assert (fitted(views) - BALL.rest).norm(dim=1).max() < 0.015


def test_without_rounds_nothing_moves():
    poses = poses_around()[:2]
    assert fitted(views_of(silhouettes(*solid("box"), poses), poses), rounds=0) is BALL.rest


def dented(vertices: Tensor) -> Tensor:
    """With a hollow in the side that faces the camera: the outlines from there do not show it."""
    near = torch.exp(-vertices[:, :2].square().sum(1) / 0.12) * (vertices[:, 2] < 0)
    return vertices + near[:, None] * torch.tensor([0.0, 0.0, 0.3])


def test_landmarks_pull_a_dent_into_the_side_that_faces_the_camera():
    fine = shape_of((0.75, 0.75, 0.75), 14)
    truth, front = dented(fine.rest), pose_of(0)
    poses = [front, pose_of(8, (1, 0, 0)), pose_of(8, (0, 1, 0))]
    seen = drawn(truth, fine.faces, [front])
    inner = torch.nonzero(seen.points[:, :2].norm(dim=1) < 0.5)[:, 0][::11]
    points = (seen.points[inner] - front.translation) @ front.R
    landmarks = Landmarks(points, torch.zeros(len(points), dtype=torch.int64))
    views = views_of(silhouettes(truth, fine.faces, poses), poses)
    alone, pulled = fitted(views), fitted(views, landmarks)
    error = [
        (drawn(shape, BALL.faces, [front]).depth[0] - seen.depth[0])
        .abs()
        .flatten()[seen.pixels[inner]]
        .mean()
        for shape in (alone, pulled)
    ]
    assert error[0] > 0.1 and error[1] < 0.3 * error[0]
    assert mean_iou(silhouettes(pulled, BALL.faces, poses), silhouettes(truth, fine.faces, poses)) > 0.97


def test_a_landmark_beside_the_silhouette_pulls_the_nearest_vertex():
    beside = torch.tensor([[0.85, 0.0, 0.0]])
    front = [pose_of(0)]
    views = views_of(silhouettes(BALL.rest, BALL.faces, front), front, torch.zeros(1))
    shape = fitted(
        views, Landmarks(beside, torch.zeros(1, dtype=torch.int64)), FitWeights(smoothness=1e-2), rounds=8
    )
    nearest = (BALL.rest - beside).norm(dim=1).argmin()
    before, after = (float((v[nearest] - beside).norm()) for v in (BALL.rest, shape))
    assert before > 0.09 and after < 0.2 * before
    assert (shape - BALL.rest)[BALL.rest[:, 0] < 0].norm(dim=1).max() < 0.2 * before


def test_landmarks_on_the_surface_pull_it_nowhere_wherever_on_their_faces_they_are():
    front = pose_of(0)
    seen = drawn(BALL.rest, BALL.faces, [front])
    points = (seen.points[::7] - front.translation) @ front.R
    landmarks = Landmarks(points, torch.zeros(len(points), dtype=torch.int64))
    views = views_of(silhouettes(BALL.rest, BALL.faces, [front]), [front], torch.zeros(1))
    shape = fitted(views, landmarks, FitWeights(smoothness=1e-3), rounds=3)
    assert (shape - BALL.rest).norm(dim=1).max() < 1e-3


def test_landmarks_count_by_their_mean():
    poses = poses_around()[:3]
    views = views_of(silhouettes(BALL.rest, BALL.faces, poses), poses)
    points = 1.08 * BALL.rest[::5]
    once = Landmarks(points, torch.zeros(len(points), dtype=torch.int64))
    twice = Landmarks(points.repeat(2, 1), once.view.repeat(2))
    assert (fitted(views, once) - fitted(views, twice)).norm(dim=1).max() < 1e-4
    assert (fitted(views, once) - fitted(views)).norm(dim=1).max() > 0.01


def test_a_landmark_ten_times_as_far_pulls_less():
    poses = poses_around()
    views = views_of(silhouettes(BALL.rest, BALL.faces, poses), poses)
    none, faint = fitted(views, rounds=1), FitWeights(landmarks=1e-3)
    moves = []
    for x in (0.85, 1.75):
        landmarks = Landmarks(torch.tensor([[x, 0.0, 0.0]]), torch.zeros(1, dtype=torch.int64))
        moves.append(float((fitted(views, landmarks, faint, rounds=1) - none).norm()))
    assert 0 < moves[1] < 0.5 * moves[0]


def test_a_mask_of_weight_zero_does_not_count():
    poses, truth = poses_around(), solid("ellipsoid")
    right = silhouettes(*truth, poses)
    wrong = right.clone()
    wrong[2] = 0
    wrong[2, 20:44, 8:56] = 1
    weight = torch.ones(len(poses))
    weight[2] = 0
    ignored = fitted(views_of(wrong, poses, weight))
    assert torch.equal(ignored, fitted(views_of(right, poses, weight)))
    assert mean_iou(silhouettes(ignored, BALL.faces, poses), right) > 0.97
    misled = fitted(views_of(wrong, poses))
    assert mean_iou(silhouettes(misled, BALL.faces, poses), right) < mean_iou(
        silhouettes(ignored, BALL.faces, poses), right
    )


def test_a_view_without_a_mask_pulls_nowhere():
    poses, truth = poses_around(), solid("ellipsoid")
    masks = silhouettes(*truth, poses)
    masks[4] = 0
    weight = torch.ones(len(poses))
    weight[4] = 0
    views = views_of(masks, poses)
    assert torch.equal(fitted(views), fitted(replace(views, weight=weight)))


def test_smoothness_keeps_the_prototype_and_nothing_else_does():
    poses = poses_around()
    views = views_of(silhouettes(*solid("box"), poses), poses)
    moves = [
        float((fitted(views, weights=FitWeights(smoothness=weight)) - BALL.rest).norm())
        for weight in (30.0, 300.0, 3e6)
    ]
    assert moves[0] > moves[1] > moves[2]


@pytest.mark.parametrize("where", ["empty masks", "full masks", "outside the window", "behind the camera"])
def test_without_a_contour_all_numbers_are_finite_and_the_surface_stays(where):
    poses = poses_around()[:3]
    masks = silhouettes(BALL.rest, BALL.faces, poses)
    if where == "empty masks":
        masks = torch.zeros_like(masks)
    if where == "full masks":
        masks = torch.ones_like(masks)
    if where == "outside the window":
        poses = [replace(pose, translation=pose.translation + torch.tensor([50.0, 0, 0])) for pose in poses]
    if where == "behind the camera":
        poses = [replace(pose, translation=-pose.translation) for pose in poses]
    views = views_of(masks, poses)
    assert torch.equal(fitted(views), BALL.rest)
    landmarks = Landmarks(BALL.rest[:20] * 1.05, torch.zeros(20, dtype=torch.int64))
    assert fitted(views, landmarks).isfinite().all()


def test_an_empty_list_of_landmarks_is_none():
    poses = poses_around()[:3]
    views = views_of(silhouettes(*solid("box"), poses), poses)
    empty = Landmarks(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64))
    assert torch.equal(fitted(views, empty), fitted(views))


# Brute force: one coordinate of one vertex after another, in float64.

EXACT = shape_of(frequency=2)
VERTICES = EXACT.rest.double()


def exact_views(count: int) -> tuple[ShapeKeyframes, list[Pose]]:
    """Views in float64 whose distance is random and rough."""
    poses = [pose_of(50 * n, (0.2, 1, 0.1)) for n in range(count)]
    batch = Pose.stack(poses)
    distance = torch.randn(count, SIZE, SIZE, generator=torch.Generator().manual_seed(0)).double()
    weight = torch.linspace(1.0, 0.3, count).double()
    K = intrinsics().double().repeat(count, 1, 1)
    return ShapeKeyframes(batch.R.double(), batch.translation.double(), K, distance, weight), poses


def in_camera(vertices: Tensor, views: ShapeKeyframes) -> Tensor:
    return vertices @ views.R.mT + views.t[:, None]


def differences(function: Callable[[Tensor], FloatArray]) -> FloatArray:
    """``(N, 3 V)`` central differences of ``function(vertices)`` ``(N,)``."""
    step, columns = 1e-6, []
    for coordinate in range(VERTICES.numel()):
        shift = torch.zeros(VERTICES.numel(), dtype=torch.float64)
        shift[coordinate] = step
        shift = shift.reshape(-1, 3)
        columns.append((function(VERTICES + shift) - function(VERTICES - shift)) / (2 * step))
    return np.stack(columns, 1)


def test_rows_of_the_outline_are_finite_differences():
    """A contour point is a fixed mixture of two vertices; its projection moves over the distance's pixels."""
    views, poses = exact_views(2)
    view = drawn(VERTICES, EXACT.faces, poses)
    contour = find_contour(view)
    total = torch.zeros(2).double().index_add(0, contour.view, contour.length)
    root = (1.7 * contour.length / total[contour.view] / 2 * views.weight[contour.view]).sqrt().numpy()

    def residual(vertices: Tensor) -> FloatArray:
        ends = in_camera(vertices, views)[contour.view[:, None], contour.vertices]
        pixel = (contour.share[..., None] * ends).sum(1) @ views.K[0].T
        x, y = (pixel[:, axis] / pixel[:, 2] for axis in (0, 1))
        return root * map_coordinates(views.distance.numpy(), [contour.view.numpy(), y, x], order=1)

    jacobian, found = _outline_rows(view, views, FitWeights(outline=1.7, outline_scale=1e9))
    assert len(found) > 100
    np.testing.assert_allclose(found, residual(VERTICES), atol=1e-9)
    np.testing.assert_allclose(jacobian.toarray(), differences(residual), atol=1e-5)


def test_rows_of_the_landmarks_are_finite_differences():
    """Landmarks on faces, each in a view that shows it: their distances from the plane of the face."""
    views, poses = exact_views(2)
    inner = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64) @ VERTICES[EXACT.faces]
    index = [drawn(VERTICES, EXACT.faces, [pose]).face_index for pose in poses]
    shown = [[face for face in range(len(EXACT.faces)) if (i == face).sum() > 12] for i in index]
    face = torch.tensor(shown[0] + shown[1])
    view = torch.tensor([0] * len(shown[0]) + [1] * len(shown[1]))
    landmarks = Landmarks(inner[face], view)
    weights = FitWeights(landmarks=1.3, landmarks_scale=1e6)

    def rows(vertices: Tensor) -> Rows:
        now = drawn(vertices, EXACT.faces, poses)
        return _covered_rows(now, *_faces_before(now, views, landmarks), views, landmarks, weights)

    jacobian, found = rows(VERTICES)
    scale = np.sqrt(1.3 / len(face)) / 1e6
    assert len(found) > 40 and np.abs(found).max() < 1e-9 * scale
    expected = differences(lambda vertices: rows(vertices)[1]) / scale
    np.testing.assert_allclose(jacobian.toarray() / scale, expected, atol=1e-6)
    assert np.abs(expected).max() > 0.3


def test_a_landmark_before_the_surface_is_as_far_from_it_as_from_the_plane_of_its_face():
    views, poses = exact_views(1)
    now = drawn(VERTICES, EXACT.faces, poses)
    face = int(now.face_index[0, SIZE // 2, SIZE // 2])
    a, b, c = VERTICES[EXACT.faces[face]]
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=0)
    landmarks = Landmarks(((a + b + c) / 3 + 0.01 * normal)[None], torch.zeros(1, dtype=torch.int64))
    _, found = _covered_rows(
        now,
        *_faces_before(now, views, landmarks),
        views,
        landmarks,
        FitWeights(landmarks=1.0, landmarks_scale=10.0),
    )
    assert found * 10 == pytest.approx([-0.01], rel=1e-3)


@pytest.mark.parametrize("stiff", [1.0, 1e4])
def test_single_precision_costs_no_digits(stiff):
    random = np.random.default_rng(0)
    rows = sparse.random(900, 300, 0.02, random_state=0)
    matrix = (rows.T @ rows + stiff * sparse.diags(random.random(300) + 0.01)).tocsr()
    exact = random.normal(size=300)
    floor = 1e-6 * matrix.diagonal().max()
    np.testing.assert_allclose(_solve(matrix, matrix @ exact + floor * exact), exact, rtol=1e-5, atol=1e-5)
