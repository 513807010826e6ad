"""First answers of a run: what a live user sees, and what is said of the same frames later."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from recorded_runs import estimate_of, write_run

from first_answers import measure
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.results import layout
from tracking3d.results.records import FrameRecord


def turned(frame: int, degrees: float) -> FrameEstimate:
    """The true answer for a frame, turned too far; every seventh frame is a keyframe."""
    R = estimate_of(0).T_cam_obj.copy()
    angle = math.radians(2 * frame + degrees)
    R[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    return replace(estimate_of(frame), T_cam_obj=R, keyframe=frame % 7 == 0 and frame > 0)


@pytest.fixture
def clip(tmp_path):
    """A clip that turns by two degrees a frame."""
    folder = tmp_path / "clip"
    (folder / "frames").mkdir(parents=True)
    poses = {}
    for frame in range(30):
        name = f"{frame:06d}"
        (folder / "frames" / f"{name}.png").touch()
        T = estimate_of(frame).T_cam_obj
        poses[name] = {"R": T[:3, :3].tolist(), "t": T[:3, 3].tolist(), "trusted": True}
    (folder / "poses.json").write_text(json.dumps({"convention": "T_cam_obj", "units": "-", "frames": poses}))
    return folder


@pytest.fixture
def run(tmp_path):
    """A run folder into which answers are written; those after the first of a frame revise it."""
    folder = tmp_path / "run"
    write_run(folder)

    def write(*answers: FrameEstimate):
        seen, lines = set[int](), []
        for answer in answers:
            lines.append(FrameRecord.of(answer, revision=answer.index in seen).to_json())
            seen.add(answer.index)
        (folder / layout.FRAMES).write_text("\n".join(lines) + "\n")
        return folder

    return write


def test_the_first_answer_of_a_keyframe_counts_and_a_revision_is_told_apart(run, clip):
    first = [turned(frame, 4.0 if frame % 7 == 0 else 0.0) for frame in range(7, 30)]
    revised = [turned(frame, 0.0) for frame in range(7, 30, 7)]
    told = measure(run(*first, *revised, replace(turned(8, 90.0), refined=True)), clip)
    assert (told["from_frame"], told["frames"], told["tracked_and_wrong"]) == (7, 23, 0)
    assert told["step_into_keyframe_deg"] == pytest.approx(4.0, abs=1e-3)
    assert told["step_out_of_keyframe_deg"] == pytest.approx(4.0, abs=1e-3)
    assert told["other_step_deg"] == pytest.approx(0.0, abs=1e-3)
    assert told["first_max_deg"] > 3 and told["revised_deg"] == pytest.approx(0.0, abs=1e-3)
    assert told["frames_a_second"] == pytest.approx(10.0)


def test_frames_before_the_first_map_are_left_out_and_wrong_tracked_ones_counted(run, clip):
    waiting = [replace(turned(frame, 50.0), keyframe=False) for frame in range(7)]
    later = [turned(frame, 40.0 if frame == 20 else 0.0) for frame in range(7, 30)]
    told = measure(run(*waiting, *later), clip)
    assert (told["from_frame"], told["tracked"], told["tracked_and_wrong"]) == (7, 23, 1)
    with pytest.raises(InputError, match="no two frames with a map"):
        measure(run(*waiting), clip)
