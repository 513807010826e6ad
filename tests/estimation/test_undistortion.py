"""A solver behind a lens: what it is shown, and what comes of its answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tracking3d.estimation.estimate import FrameEstimate, MaskSource, Status
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.estimation.undistortion import undistort_solver
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.lens import Lens

LENS = Lens.of("radtan", (-0.25, 0.05, 0.0, 0.0), (110.0, 110.0, 63.5, 47.5), 128, 96)
TAKEN = np.zeros((96, 128), bool)
TAKEN[10:50, 60:110] = True
IMAGE = np.random.default_rng(0).integers(0, 256, (96, 128, 3)).astype(np.uint8)
FRAME = Frame(3, IMAGE)


class Causal:
    """Answers with the mask that it is given, or with one of its own."""

    def __init__(self, own: np.ndarray | None = None) -> None:
        self.own, self.shown = own, []

    def init(self, frame, mask):
        return self.step("started", frame, mask)

    def step(self, state, frame, mask):
        self.shown.append((frame.image, mask.mask))
        given = mask.found
        estimate = FrameEstimate(
            frame.index, None, np.eye(4), given if self.own is None else self.own, given, Status.TRACKED, "", 1.0,
            mask_source=MaskSource.INITIAL if self.own is None else MaskSource.RENDERED,
        )  # fmt: skip
        return state, replace(estimate, revised=(replace(estimate, index=0),))

    def result(self, state):
        return state


class Whole(Causal, RefiningSolver):
    def refine(self, state):
        return f"{state}, refined"

    def refine_frame(self, state, frame, mask, T_cam_obj):
        return self.step(state, frame, mask)

    def restart_backwards(self, state, frame, number, T_cam_obj):
        self.shown.append((frame.image, number))
        return state

    def trust_mask(self, state, frame, mask):
        self.shown.append((frame.image, mask))
        return state


def test_without_a_lens_it_is_the_solver_itself():
    solver = Causal()
    assert undistort_solver(None, solver) is solver


@pytest.mark.parametrize(("kind", "complete"), [(Causal, False), (Whole, True)])
def test_it_can_do_what_the_solver_can(kind, complete):
    solver = undistort_solver(LENS, kind())
    assert isinstance(solver, RefiningSolver) is complete


def test_the_solver_sees_pinhole_pictures_and_masks():
    inner = Whole()
    solver = undistort_solver(LENS, inner)
    solver.init(FRAME, MaskEstimate(TAKEN.astype(np.float32)))
    solver.trust_mask("", FRAME, TAKEN)
    solver.restart_backwards("", FRAME, 9, np.eye(4))
    for image, _ in inner.shown:
        np.testing.assert_array_equal(image, LENS.undistort(IMAGE))
    soft, trusted = inner.shown[0][1], inner.shown[1][1]
    assert soft.dtype == np.float32
    np.testing.assert_array_equal(soft >= 0.5, LENS.mask_to_pinhole(TAKEN))
    np.testing.assert_array_equal(trusted, LENS.mask_to_pinhole(TAKEN))
    assert solver.result(solver.refine("a")) == "a, refined"


def test_a_mask_that_is_handed_back_is_the_one_that_was_given():
    _, estimate = undistort_solver(LENS, Causal()).step("", FRAME, MaskEstimate(TAKEN.astype(np.float32)))
    np.testing.assert_array_equal(estimate.mask, TAKEN)
    np.testing.assert_array_equal(estimate.initial_mask, TAKEN)


def test_a_mask_of_its_own_is_distorted():
    own = np.zeros((96, 128), bool)
    own[30:60, 20:60] = True
    _, estimate = undistort_solver(LENS, Whole(own)).refine_frame(
        "", FRAME, MaskEstimate(TAKEN.astype(np.float32)), np.eye(4)
    )
    for one in (estimate, *estimate.revised):
        np.testing.assert_array_equal(one.mask, LENS.mask_to_picture(own))
    np.testing.assert_array_equal(estimate.initial_mask, TAKEN)
    [revised] = estimate.revised
    assert (revised.initial_mask & TAKEN).sum() / (revised.initial_mask | TAKEN).sum() > 0.97


def test_a_frame_without_a_mask_stays_without():
    inner = Causal(own=np.zeros((96, 128), bool))
    _, estimate = undistort_solver(LENS, inner).step("", FRAME, MaskEstimate(None))
    assert inner.shown[0][1] is None and estimate.initial_mask is None and not estimate.mask.any()
