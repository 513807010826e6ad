"""A solver behind a lens: what it is shown, and what comes of its estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import FrameEstimate, MaskSource, Status
from tracking3d.estimation.solver import Gap, PhotoEstimates, PhotoSet, RefiningSolver
from tracking3d.estimation.undistortion import Undistortion
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.geometry.lens import Lens
from tracking3d.pipeline.session import SOLVERS, Session

LENS = Lens.of("radtan", (-0.25, 0.05, 0.0, 0.0), (110.0, 110.0, 63.5, 47.5), 128, 96)
TAKEN = np.zeros((96, 128), bool)
TAKEN[10:50, 60:110] = True
IMAGE = np.random.default_rng(0).integers(0, 256, (96, 128, 3)).astype(np.uint8)
FRAME = Frame(3, IMAGE)
GIVEN = MaskEstimate(TAKEN.astype(np.float32))
OWN = np.zeros((96, 128), bool)
OWN[30:60, 20:60] = True


def estimate(mask: np.ndarray, source: MaskSource) -> FrameEstimate:
    """What a solver says of the frame, with an estimate of an earlier one."""
    initial = LENS.mask_to_pinhole(TAKEN)
    found = FrameEstimate(3, None, np.eye(4), mask, initial, Status.TRACKED, "", 1.0, mask_source=source)
    return replace(found, revised=(replace(found, index=0),))


def test_without_a_lens_everything_stays_as_it_is():
    nothing, found = Undistortion(None), estimate(OWN, MaskSource.RENDERED)
    assert nothing.frame(FRAME) is FRAME and nothing.mask(GIVEN) is GIVEN
    assert nothing.binary(TAKEN) is TAKEN and nothing.estimate(found, GIVEN) is found


def test_a_mask_that_is_handed_back_is_the_one_that_was_given():
    seen = Undistortion(LENS).estimate(estimate(LENS.mask_to_pinhole(TAKEN), MaskSource.INITIAL), GIVEN)
    np.testing.assert_array_equal(seen.mask, TAKEN)
    np.testing.assert_array_equal(seen.initial_mask, TAKEN)


def test_a_mask_of_its_own_is_distorted():
    found = Undistortion(LENS).estimate(estimate(OWN, MaskSource.RENDERED), GIVEN)
    for one in (found, *found.revised):
        np.testing.assert_array_equal(one.mask, LENS.mask_to_picture(OWN))
    np.testing.assert_array_equal(found.initial_mask, TAKEN)
    [revised] = found.revised
    assert (revised.initial_mask & TAKEN).sum() / (revised.initial_mask | TAKEN).sum() > 0.97


def test_a_frame_without_a_mask_stays_without():
    assert Undistortion(LENS).mask(MaskEstimate(None)).mask is None
    missing = replace(estimate(np.zeros_like(OWN), MaskSource.NONE), initial_mask=None, revised=())
    found = Undistortion(LENS).estimate(missing, MaskEstimate(None))
    assert found.initial_mask is None and not found.mask.any()


def test_an_occluder_is_undistorted_with_its_mask():
    seen = Undistortion(LENS).mask(replace(GIVEN, occluder=OWN.astype(np.float32)))
    np.testing.assert_array_equal(seen.occluder, LENS.mask_to_pinhole(OWN.astype(np.float32)))


class Watching(RefiningSolver):
    """Keeps what it is shown; its estimates have the mask that it is given."""

    shown: list  # (method, image, mask)

    def __init__(self, config, camera, encoder) -> None:
        self.shown = []

    def init(self, frame, mask):
        return self.step("started", frame, mask)

    def step(self, state, frame, mask):
        self.shown.append(("step", frame.image, mask.mask))
        initial = mask.found
        return state, FrameEstimate(
            frame.index, None, np.eye(4), initial, initial, Status.TRACKED, "", 1.0,
            mask_source=MaskSource.INITIAL,
        )  # fmt: skip

    def refine(self, state):
        return f"{state}, refined"

    def refine_frame(self, state, frame, mask, T_cam_obj):
        return self.step(state, frame, mask)

    def restart_backwards(self, state, frame, number, T_cam_obj):
        self.shown.append(("restart_backwards", frame.image, None))
        return state

    def trust_mask(self, state, frame, mask):
        self.shown.append(("trust_mask", frame.image, mask))
        return state

    def keep_frame(self, state, frame, T_cam_obj):
        self.shown.append(("keep_frame", frame.image, None))
        return state

    def extend(self, state, gap):
        self.shown.append(("extend", gap.anchor.image, None))
        return state, [self.step(state, *pair)[1] for pair in gap.frames]

    def start_from_photos(self, state, photos):
        found = tuple(self.step(state, *pair)[1] for pair in photos.read(photos.indices))
        return state, PhotoEstimates(found, "")


@pytest.fixture
def session(monkeypatch) -> Session:
    monkeypatch.setitem(SOLVERS, "online", Watching)
    config = load_config(
        camera={"intrinsics": (110.0, 110.0, 63.5, 47.5), "distortion": (-0.25, 0.05, 0.0, 0.0)},
        tracker={"name": "csrt"},
        features={"name": "rgb"},
    )
    return Session(config, Prompt((60, 10, 50, 40), TAKEN))


def test_a_session_shows_its_solver_pinhole_pictures_and_masks_alone(session):
    first = session.step(FRAME)
    np.testing.assert_array_equal(first.mask, TAKEN)
    session.step(Frame(4, IMAGE), Prompt((60, 10, 50, 40), TAKEN))
    session.extend(Gap(FRAME, [(Frame(4, IMAGE), GIVEN)], backwards=False))
    session.start_from_photos(PhotoSet((3,), lambda indices: iter([(FRAME, GIVEN)])))
    session.attempt([(FRAME, GIVEN), (Frame(2, IMAGE), GIVEN)])
    session.step(Frame(2, IMAGE))
    session.refine()
    again = session.refine_frame(FRAME, GIVEN, np.eye(4))
    np.testing.assert_array_equal(again.mask, TAKEN)
    session.keep_frame(FRAME, np.eye(4))
    shown = session._solver.shown
    assert {name for name, _, _ in shown} == {
        "step",
        "trust_mask",
        "extend",
        "restart_backwards",
        "keep_frame",
    }
    for name, image, mask in shown:
        np.testing.assert_array_equal(image, LENS.undistort(IMAGE), err_msg=name)
        if name == "trust_mask":
            np.testing.assert_array_equal(mask, LENS.mask_to_pinhole(TAKEN))
    np.testing.assert_array_equal(shown[0][2] >= 0.5, LENS.mask_to_pinhole(TAKEN))
