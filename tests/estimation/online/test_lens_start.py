"""Where nobody gave the lens, the start is solved with several and goes on with the likeliest."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from online_runs import estimate_of
from turned_solid import turned_map

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.estimation.online.mapping.focal_length import lens_hypotheses, with_focal_length
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.rendering import project
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

FRAMES, FOV = 14, 12.0
SOON = 6
"""Frames until the start is over."""


@cache
def clip() -> SyntheticClip:
    """A box with cut corners through a long lens, turning 5 degrees a frame."""
    return synthesize(
        SyntheticSpec(frames=FRAMES, size=(160, 120), degrees_per_frame=5.0, drift=(0.1, 0.0, 0.1), fov=FOV)
    )


@cache
def answers(assumed: bool, frames: int = FRAMES) -> list[FrameEstimate]:
    """The latest causal answer for every frame, with 45 degrees as the assumed or the given lens."""
    width, height = 160, 120
    camera = replace(Camera.from_fov(width, height), assumed=assumed)
    config = load_config(preset="default", overrides=["object.frequency=7"])
    solver = OnlineSolver(config, camera, RgbEncoder())
    found: dict[int, FrameEstimate] = {}
    state = None
    for index in range(frames):
        frame, mask = Frame(index, clip().images[index]), estimate_of(clip().masks[index])
        state, estimate = solver.init(frame, mask) if state is None else solver.step(state, frame, mask)
        found |= {one.index: one for one in (*estimate.revised, estimate)}
    return [found[index] for index in range(frames)]


def error(assumed: bool) -> float:
    found = np.array([estimate.T_cam_obj[:3, :3] for estimate in answers(assumed)])
    truth = np.array([pose[:3, :3] for pose in clip().T_cam_obj])
    return float(np.mean(aligned_rotation_errors(found, truth)))


@pytest.mark.slow
def test_a_longer_lens_is_chosen_and_the_poses_are_better_with_it():
    camera = answers(True)[-1].camera
    assert camera is not None and camera.assumed
    assert 0.6 * FOV < camera.fov < 30  # a few degrees of turn tell no more
    assert f"{camera.fov:.1f} degrees" in camera.origin  # solved by dense landmarks after the start
    assert error(True) < 0.6 * error(False)


def test_a_given_lens_stays():
    assert {estimate.camera.origin for estimate in answers(False, SOON) if estimate.camera} == {
        "default field of view"
    }
    assert len(lens_hypotheses(Camera.from_fov(160, 120, 30.0))) == 1


def test_answers_from_before_the_start_are_given_anew_with_its_camera():
    assert answers(True, SOON)[-1].status is Status.TRACKED
    assert len({estimate.camera for estimate in answers(True, SOON)}) == 1


def test_hypotheses_begin_with_the_assumed_lens_and_keep_the_shape_of_pixels():
    camera = Camera(500.0, 480.0, 70.0, 60.0, 160, 120, assumed=True)
    hypotheses = lens_hypotheses(camera)
    assert hypotheses[0] is camera
    angles = [one.fov for one in hypotheses[1:]]
    assert min(angles) == pytest.approx(9.0) and max(angles) == pytest.approx(65.0)
    for one in hypotheses:
        assert one.fx / one.fy == pytest.approx(500 / 480) and (one.cx, one.cy) == (70.0, 60.0)
        assert one.assumed


def test_through_another_lens_the_origin_stays_where_it_is_seen():
    view = turned_map([0.0]).keyframes[0]
    before = Camera.from_fov(64, 64, 45.0)
    after = before.zoom(3.0, "")
    other = with_focal_length(view, before, after)
    seen = [
        project(torch.zeros(1, 3), one.pose.R[None], one.pose.translation[None], one.observation.K[None])[0]
        for one in (view, other)
    ]
    torch.testing.assert_close(seen[0], seen[1])
    assert float(other.pose.translation[2]) == pytest.approx(3 * float(view.pose.translation[2]))
    assert torch.equal(other.observation.features, view.observation.features)
