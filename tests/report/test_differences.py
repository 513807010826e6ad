"""What differs between runs: nothing between a run and itself, and exactly what was changed otherwise."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from turning_sphere import TurningSphere, turning_sphere_of, written_run

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.geometry.camera import Camera
from tracking3d.ui.report.comparison import write_comparison
from tracking3d.ui.report.differences import Difference, compare_runs, worst_frames

FRAMES = 12


@pytest.fixture(scope="module")
def clip() -> TurningSphere:
    return turning_sphere_of(FRAMES)


@pytest.fixture
def run_of(tmp_path, clip):
    """Write a run whose answers are changed: ``run_of(name, change, **changes_of_the_writer)``."""

    def write(name: str, change=lambda estimate: estimate, frames: int = FRAMES, **about) -> Path:
        changed = dataclasses.replace(
            clip, frames=clip.frames[:frames], estimates=[change(one) for one in clip.estimates[:frames]]
        )
        written_run(tmp_path / name, changed, with_model=False, **about)
        return tmp_path / name

    return write


def moved(estimate: FrameEstimate, T: np.ndarray) -> FrameEstimate:
    return dataclasses.replace(estimate, T_cam_obj=T)


def test_a_run_does_not_differ_from_itself(run_of):
    folder = run_of("a")
    comparison = compare_runs([folder, folder])
    [one] = comparison.differences
    assert one.iou == pytest.approx(1)
    assert np.abs(one.rotation).max() < 1e-3
    assert np.abs(one.translation).max() < 1e-3
    assert comparison.settings == {}
    assert comparison.worst == []
    assert comparison.notes == []


def test_frame_and_unit_of_the_object_are_no_difference(run_of):
    own = np.eye(4)
    own[:3, :3] = Rotation.from_euler("xyz", [20, 70, -40], degrees=True).as_matrix()
    own[:3, 3] = 0.1, -0.2, 0.05

    def change(estimate):
        T = estimate.T_cam_obj @ own
        T[:3, 3] *= 2.5
        return moved(estimate, T)

    [one] = compare_runs([run_of("a"), run_of("b", change)]).differences
    assert np.nanmax(one.rotation) < 0.1
    assert np.nanmax(one.translation) < 0.1
    assert one.scale == pytest.approx(1 / 2.5, rel=1e-3)


def test_a_turn_in_one_frame_is_found_there(run_of):
    def change(estimate):
        if estimate.index != 7:
            return estimate
        T = estimate.T_cam_obj.copy()
        T[:3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix() @ T[:3, :3]
        return moved(estimate, T)

    comparison = compare_runs([run_of("a"), run_of("b", change)])
    [one] = comparison.differences
    assert one.rotation.argmax() == 7
    assert one.rotation[7] == pytest.approx(30, abs=3)
    assert np.median(one.rotation) < 3
    assert 7 in comparison.worst


def test_a_shifted_mask_is_found_with_its_overlap(run_of):
    def change(estimate):
        shifted = np.roll(estimate.mask, 20, axis=0)
        return dataclasses.replace(estimate, mask=shifted) if estimate.index == 3 else estimate

    comparison = compare_runs([run_of("a"), run_of("b", change)])
    [one] = comparison.differences
    a, b = (comparison.runs[number].mask(3) for number in (0, 1))
    assert one.iou[3] == pytest.approx((a & b).sum() / (a | b).sum())
    assert one.summary["iou_least"] == pytest.approx(one.iou[3])
    assert comparison.worst == [3]


def test_lost_frames_have_no_pose_to_compare(run_of):
    def change(estimate):
        return dataclasses.replace(estimate, status=Status.LOST) if estimate.index >= 9 else estimate

    [one] = compare_runs([run_of("a"), run_of("b", change)]).differences
    assert np.isnan(one.rotation).tolist() == [False] * 9 + [True] * 3
    all_lost = run_of("c", lambda estimate: dataclasses.replace(estimate, status=Status.LOST))
    comparison = compare_runs([run_of("d"), all_lost])
    assert comparison.differences[0].summary["rotation_median_deg"] is None
    assert comparison.notes == ["No frame has a pose in both d and c."]


def test_only_settings_that_differ_are_named(run_of):
    settings = {"solver": {"name": "online", "local_window": 12}, "camera": {"fov": None}}
    other = {"solver": {"name": "online", "local_window": 8}, "camera": {"fov": None}, "crop": {"size": 64}}
    comparison = compare_runs([run_of("a", config=settings), run_of("b", config=other)])
    assert comparison.settings == {"solver.local_window": ["12", "8"], "crop.size": [None, "64"]}


def test_runs_of_different_lengths_are_compared_where_both_have_answers(run_of):
    comparison = compare_runs([run_of("long"), run_of("short", frames=5)])
    assert comparison.differences[0].indices.tolist() == [0, 1, 2, 3, 4]
    assert comparison.notes == [
        "long has estimates for 12 frames and short for 5; they are compared in the 5 frames that both have."
    ]


def test_what_cannot_be_of_one_video_is_refused(run_of, tmp_path):
    folder = run_of("a", frames=3)
    clip = turning_sphere_of(2, 80, 60)
    written_run(tmp_path / "small", clip, with_model=False)
    with pytest.raises(InputError, match=r"have 160 x 120 pixels and .* have 80 x 60"):
        compare_runs([folder, tmp_path / "small"])
    later = run_of("b", lambda estimate: dataclasses.replace(estimate, index=estimate.index + 100), frames=3)
    with pytest.raises(InputError, match="no common frame"):
        compare_runs([folder, later])
    with pytest.raises(InputError, match="two run folders or more"):
        compare_runs([folder])
    with pytest.raises(InputError, match="not a run folder"):
        compare_runs([folder, tmp_path])


def test_doubts_about_the_comparison_are_said(run_of, clip):
    first = {"frames": 12, "first_frame": 0, "first_image_crc": 1}
    a = run_of("a", prompt=first)
    b = run_of("b", prompt=first | {"first_image_crc": 2}, camera=Camera.from_fov(160, 120, 20))
    run = json.loads((b / "run.json").read_text())
    (b / "run.json").write_text(json.dumps(run | {"state": "interrupted"}))
    told = " ".join(compare_runs([a, b]).notes)
    assert "b is interrupted: 12 frames have an estimate." in told
    assert "The first images of a and b differ" in told
    assert "different focal lengths" in told


def test_worst_frames_are_few_and_apart():
    count = 60
    iou = 1 - np.linspace(0, 0.5, count)
    rotation = np.where(np.arange(count) == 5, 90.0, 0.0)
    one = Difference("b", np.arange(count), iou, rotation, np.zeros(count), 1.0)
    worst = worst_frames([one])
    assert worst == sorted(worst)
    assert {5, count - 1} <= set(worst)
    assert len(worst) <= 6
    assert min(np.diff(worst)) >= 5


def test_the_page_shows_the_frames_that_differ_most_in_every_run(run_of, tmp_path):
    def change(estimate):
        return dataclasses.replace(estimate, mask=np.roll(estimate.mask, 2 * estimate.index, axis=0))

    comparison = compare_runs([run_of("a"), run_of("b", change), run_of("<i>c")])
    write_comparison(comparison, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.count("<img ") == 3 * len(comparison.worst) > 3
    assert "&lt;i&gt;c" in page
    assert "<i>" not in page
    assert "None: all runs have the same settings." in page
    assert json.dumps(comparison.as_json())


def test_other_frames_that_were_asked_for_are_a_difference_of_settings(run_of):
    a, b = run_of("a"), run_of("b")
    assert not compare_runs([a, b]).settings
    told = json.loads((b / "run.json").read_text()) | {"selection": "0:12"}
    (b / "run.json").write_text(json.dumps(told))
    assert compare_runs([a, b]).settings == {"selected frames": ["all", "0:12"]}


def test_any_run_may_be_the_one_that_others_are_held_against(run_of):
    a, b, c = (run_of(name) for name in "abc")
    comparison = compare_runs([a, b, c], against=b)
    assert comparison.names == ["b", "a", "c"]
    assert compare_runs([a], against=c).names == ["c", "a"]
    with pytest.raises(InputError, match="needs two run folders or more"):
        compare_runs([a], against=a)


def test_every_two_runs_are_compared(run_of, tmp_path):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 20, degrees=True).as_matrix()

    def change(estimate):  # one that a turn of the object does not explain
        return moved(estimate, estimate.T_cam_obj @ turn if estimate.index % 2 else estimate.T_cam_obj)

    comparison = compare_runs([run_of("a"), run_of("b", change), run_of("c", change)])
    between = comparison.rotation_between
    assert between[0, 1] == pytest.approx(between[1, 0])
    assert between[0, 1] == pytest.approx(comparison.differences[0].summary["rotation_median_deg"])
    assert between[0, 1] > 5 > 0.01 > between[1, 2]
    assert comparison.iou_between == pytest.approx(np.ones((3, 3)))
    told = comparison.as_json()["every_pair"]
    assert [one["runs"] for one in told] == [["a", "b"], ["a", "c"], ["b", "c"]]
    write_comparison(comparison, tmp_path / "page.html")
    assert "All pairs of runs" in (tmp_path / "page.html").read_text()
