"""A run folder is followed as it grows, and nothing of it is believed that is not whole."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recorded_runs import estimate_of, frame_of, model, open_run, write_run

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.results.checkpoint.serialization import TreeFolder
from tracking3d.ui.viewer.followed_run import FollowedRun, landmarks_of_checkpoint, open_followed_runs


def followed(folder: Path) -> FollowedRun:
    run = FollowedRun(folder, "run")
    run.look_again()
    return run


def test_a_run_is_followed_while_it_goes_on(tmp_path):
    with open_run(tmp_path / "run") as writer:
        run = followed(tmp_path / "run")
        assert run.going_on and not run.frames and run.model is None
        for index in range(3):
            writer.write(estimate_of(index), frame_of(index))
            assert run.look_again()
            assert list(run.frames) == list(range(index + 1))
        assert not run.look_again()
        writer.write(estimate_of(1, Status.LOST, "anew"), frame_of(1))
        run.look_again()
        assert run.frames[1].reason == "anew" and run.frames[1].name == frame_of(1).name
        writer.finish(model(), "finished")
    assert run.look_again()
    assert not run.going_on and run.model is not None


def test_a_line_is_taken_when_it_is_whole_and_damage_is_told(run):
    path = run / "frames.jsonl"
    lines = path.read_bytes()
    path.write_bytes(lines[:-40])
    follower = followed(run)
    assert list(follower.frames) == list(range(11))
    path.write_bytes(lines)
    assert follower.look_again() and list(follower.frames) == list(range(12))
    path.write_bytes(lines + b'{"index": 12}\n')
    with pytest.raises(InputError, match="damaged"):
        follower.look_again()


def test_a_run_that_is_cut_back_or_begun_anew_is_read_from_its_beginning(run):
    follower = followed(run)
    path = run / "frames.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:4]))
    follower.look_again()
    assert list(follower.frames) == [0, 1, 2, 3]


def test_what_is_removed_under_the_viewer_ends_nothing(run):
    follower = followed(run)
    for path in run.rglob("*"):
        if path.is_file():
            path.unlink()
    assert not follower.look_again()
    assert len(follower.frames) == 12 and follower.mask(0, "refined") is None


def test_answers_before_and_after_the_refinement_are_told_apart(run):
    path = run / "frames.jsonl"
    line = {**json.loads(path.read_text().splitlines()[0]), "refined": True, "confidence": 0.123}
    with path.open("a") as file:
        file.write(json.dumps(line) + "\n")
    follower = followed(run)
    assert follower.refined
    assert (follower.frames[0].confidence, follower.causal[0].confidence) == (0.123, 0.9)


def test_a_mask_of_another_size_is_none(run):
    from tracking3d.results.files import write_mask

    follower = followed(run)
    assert follower.mask(0, "refined").shape == (64, 96)
    write_mask(run / "masks" / "000000.png", np.ones((5, 5), bool))
    assert follower.mask(0, "refined") is None


def test_objects_of_one_video_come_in_their_order_with_the_names_they_were_picked_with(tmp_path):
    for number in range(11):
        write_run(tmp_path / "runs" / f"object_{number}", 2)
    (tmp_path / "runs" / "picked.json").write_text(
        json.dumps({"objects": [{"name": "cup"}, {"name": "box"}]})
    )
    names = [run.name for run in open_followed_runs(tmp_path / "runs")]
    assert names[:3] == ["cup", "box", "object_2"] and names[-1] == "object_10"
    (tmp_path / "runs" / "picked.json").write_text('{"objects": 7}')
    assert open_followed_runs(tmp_path / "runs")[0].name == "object_0"


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="is not a run folder"):
        open_followed_runs(tmp_path)


def kept_state(folder: Path, points: np.ndarray) -> Path:
    """A state as a run keeps it, with nothing in it but landmarks."""
    (folder / ".state").mkdir()
    landmarks = json.loads(TreeFolder(folder / ".state", ()).text(points))
    solver = {
        "class": "Belief",
        "fields": {"known": {"class": "ObjectMap", "fields": {"landmarks": landmarks}}},
    }
    state = folder / ".state" / "state.json"
    state.write_text(json.dumps({"version": 1, "session": {"dict": [["solver", solver]]}}))
    return state


def test_landmarks_are_read_from_the_state_of_a_run(tmp_path):
    points = np.random.default_rng(0).normal(size=(200, 3))
    points[5] = np.nan
    assert landmarks_of_checkpoint(tmp_path) is None
    state = kept_state(tmp_path, points)
    assert np.allclose(landmarks_of_checkpoint(tmp_path), np.delete(points, 5, axis=0))
    for file in ("../../secret.npz", "00000000.npy", 7):
        state.write_text(state.read_text().replace('"00000000.npz"', json.dumps(file)))
        assert landmarks_of_checkpoint(tmp_path) is None
        state.write_text(state.read_text().replace(json.dumps(file), '"00000000.npz"'))
    np.savez(tmp_path / ".state" / "00000000.npz", array=np.array([{"a": 1}], dtype=object))
    assert landmarks_of_checkpoint(tmp_path) is None
