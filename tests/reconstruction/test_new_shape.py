"""A reconstructed shape replaces the old one only if it explains frames better that it has not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered_views import ball
from scipy.spatial.transform import Rotation
from test_volume import shape_views

from tracking3d.points.outline_fit import fit_to_outlines
from tracking3d.reconstruction.held_out_test import HeldOutScore, is_held_out, score_held_out
from tracking3d.reconstruction.photometric_poses import coloured_surface, refine_views
from tracking3d.reconstruction.seen_regions import seen_vertices
from tracking3d.reconstruction.shape import reconstruct_shape


def turned(view, degrees: float):
    pose = view.T_cam_obj.copy()
    pose[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix() @ pose[:3, :3]
    return replace(view, T_cam_obj=pose)


@pytest.mark.parametrize(
    ("yaws", "words"), [(range(0, 30, 10), "frames differ enough"), (np.arange(0, 14, 1.1), "turns by")]
)
def test_too_little_is_said_and_the_shape_stays(yaws, words):
    model = ball()
    views = shape_views(yaws)
    made = reconstruct_shape([(model.vertices, model.faces)], views, views[:1])
    assert made.vertices is None and words in made.sentence


def test_no_outline_is_given_for_colours():
    old = HeldOutScore(0.95, 0.05)
    assert HeldOutScore(0.96, 0.05).better_than(old) and HeldOutScore(0.95, 0.04).better_than(old)
    assert not old.better_than(old)
    assert not HeldOutScore(0.93, 0.01).better_than(old)


def test_the_true_shape_explains_frames_best():
    model, views = ball(), shape_views(range(0, 60, 12))
    right = score_held_out(model.vertices, model.faces, views[::2], views[1::2])
    wrong = score_held_out(0.8 * model.vertices, model.faces, views[::2], views[1::2])
    assert right.iou > 0.95 and right.better_than(wrong)


def test_a_pose_that_is_off_is_brought_back():
    model, views = ball(), shape_views(range(0, 72, 8))
    off = [*views[:4], turned(views[4], 2.0), *views[5:]]
    found = refine_views(coloured_surface(model.vertices, model.faces, views), off)
    left = Rotation.from_matrix(found[4].T_cam_obj[:3, :3] @ views[4].T_cam_obj[:3, :3].T).magnitude()
    assert np.degrees(left) < 0.5


def test_the_back_is_not_seen():
    model, (view,) = ball(), shape_views([0])
    seen = seen_vertices(model.vertices, model.faces, [view])
    towards = -model.vertices[:, 2]  # the camera stands at negative z
    assert seen[towards > 0.4].all() and not seen[towards < 0].any()


def test_every_eighth_frame_is_left_out():
    assert [place for place in range(24) if is_held_out(place)] == [4, 12, 20]


def test_vertices_go_to_where_the_outlines_are():
    model, views = ball(), shape_views(range(0, 180, 20))
    small = 0.95 * model.vertices
    fitted = fit_to_outlines(small, model.faces, views)
    # All views look along the horizon: the ring that they see goes out, and the poles with it.
    radius = np.linalg.norm(fitted, axis=1)
    assert np.abs(radius - 1).mean() < 0.5 * 0.05
    assert score_held_out(fitted, model.faces, views[::2], views[1::2]).iou > 0.97
