"""Changes of a sequence's input: what they change, what they leave, and for what they mean nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d_bench.benchmark.input_change import InputChange
from tracking3d_bench.datasets.truth import PointTruth, Truth

CAMERA = Camera(500.0, 510.0, 31.5, 23.5, 64, 48)


class Square:
    """A mask whose box starts at (x, 10) and has a side of 8."""

    def __init__(self, x: int) -> None:
        self.x = x

    def read(self) -> np.ndarray:
        mask = np.zeros((48, 64), bool)
        mask[10:18, self.x : self.x + 8] = True
        return mask


TRUTH = Truth(
    "clip",
    tuple(Path(f"{n:06d}.jpg") for n in range(6)),
    box=(4.0, 10.0, 8.0, 8.0),
    camera=CAMERA,
    camera_told=False,
    T_cam_obj={n: np.eye(4) * (n + 1) for n in range(6)},
    masks={0: Square(4), 2: Square(6), 3: Square(7)},
    points=PointTruth(np.arange(12.0).reshape(6, 1, 2), np.ones((6, 1), bool)),
)


def test_nothing_changed_is_the_same_sequence():
    assert InputChange().apply(TRUTH) is TRUTH


def test_the_lens_is_given_scaled_or_withheld_and_the_truth_stays():
    given = InputChange(lens="given", focal_scale=1.02).apply(TRUTH)
    assert given.camera_told and given.camera == CAMERA
    assert given.given_camera is not None
    assert (given.given_camera.fx, given.given_camera.fy) == pytest.approx((510.0, 520.2))
    withheld = InputChange(lens="withheld").apply(given)
    assert not withheld.camera_told and withheld.camera == CAMERA


def test_a_box_moves_to_the_right_and_down_and_grows_about_its_centre():
    assert InputChange(box_shift=(2, 1)).apply(TRUTH).box == (6.0, 11.0, 8.0, 8.0)
    assert InputChange(box_growth=0.5).apply(TRUTH).box == (2.0, 8.0, 12.0, 12.0)


def test_a_later_first_frame_shifts_all_that_is_known():
    later = InputChange(first_frame=2).apply(TRUTH)
    assert later.names[0] == "000002" and len(later.frames) == 4
    assert later.box == (6.0, 10.0, 8.0, 8.0)  # of its mask
    assert set(later.masks) == {0, 1} and set(later.T_cam_obj) == {0, 1, 2, 3}
    assert later.T_cam_obj[0][0, 0] == 3
    assert later.points is not None and later.points.positions[0, 0, 0] == 4.0
    assert (
        InputChange(first_frame=1).apply(TRUTH).box == TRUTH.box
    )  # of the nearest frame, the earlier of two


@pytest.mark.parametrize(
    ("change", "masks", "reason"),
    [
        (InputChange(lens="given"), "tracker", ""),
        (InputChange(lens="withheld"), "tracker", "not given anyway"),
        (InputChange(box_growth=0.1), "truth", "does not start from a box"),
        (InputChange(first_frame=5), "tracker", "too few frames"),
        (InputChange(grey_noise=1), "truth", ""),
    ],
)
def test_a_change_that_means_nothing_has_a_reason(change, masks, reason):
    found = change.reason_against(TRUTH, masks)
    assert reason in found and bool(found) == bool(reason)


def test_a_box_that_is_unknown_at_the_later_frame_is_a_reason():
    frames = tuple(Path(f"{n}.jpg") for n in range(20))
    far = Truth("clip", frames, box=(4.0, 10.0, 8.0, 8.0), masks={0: Square(4)})
    assert "box there is unknown" in InputChange(first_frame=9).reason_against(far, "tracker")
    assert InputChange(first_frame=3).reason_against(far, "tracker") == ""


def test_impossible_changes_are_refused():
    with pytest.raises(InputError, match="cannot start at frame 6"):
        InputChange(first_frame=6).apply(TRUTH)
    for wrong in ({"focal_scale": 0.0}, {"box_growth": -1.0}, {"first_frame": -1}, {"lens": "long"}):
        with pytest.raises(ValidationError):
            InputChange.model_validate(wrong)
