"""Two run folders are compared by what every version writes: poses, masks, vertices."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from same_answers import array_difference, compare, read_poses


@pytest.fixture
def run(tmp_path):
    """A run folder of two frames, the second of which has a refined pose, too."""
    folder = tmp_path / "run"
    (folder / "masks").mkdir(parents=True)
    rows = [(0, False, 1.0), (1, False, 2.0), (1, False, 2.5), (1, True, 3.0)]
    lines = [
        json.dumps({"index": index, "refined": refined, "T_cam_obj": (z * np.eye(4)).tolist(), "renamed": 1})
        for index, refined, z in rows
    ]
    (folder / "frames.jsonl").write_text("\n".join(lines) + "\n")
    mask = np.zeros((8, 8), np.uint8)
    mask[2:5, 2:5] = 255
    for index in range(2):
        cv2.imwrite(str(folder / f"masks/{index:06d}.png"), mask)
    (folder / "mesh.obj").write_text("# ours\nv 0 0 1\nv 1 0 0.5\nvt 0 0\nf 1 2 1\n")
    return folder


@pytest.fixture
def other(run, tmp_path):
    return shutil.copytree(run, tmp_path / "other")


def replace(file, before: str, after: str) -> None:
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))


def test_the_last_line_of_a_frame_counts_causal_and_refined_apart(run):
    assert {index: T[2, 2] for index, T in read_poses(run, refined=False).items()} == {0: 1.0, 1: 2.5}
    assert {index: T[2, 2] for index, T in read_poses(run, refined=True).items()} == {1: 3.0}


def test_a_run_is_the_same_as_its_copy_whatever_its_keys_are_called(run, other):
    replace(other / "frames.jsonl", "renamed", "diagnostics")
    found = compare(run, other)
    assert found.same
    assert (found.frames, found.masks, found.pixels, found.vertices) == ((2, 1), 2, 0, 0.0)


@pytest.mark.parametrize(
    ("before", "after", "causal", "refined"),
    [("2.5", "2.500001", 1e-6, 0.0), ("3.0", "3.25", 0.0, 0.25), ("3.0", "NaN", 0.0, np.inf)],
)
def test_a_pose_that_differs_is_found(run, other, before, after, causal, refined):
    replace(other / "frames.jsonl", before, after)
    found = compare(run, other)
    assert not found.same
    assert (found.causal, found.refined) == pytest.approx((causal, refined))


def test_a_frame_without_a_pose_on_one_side_differs_without_bound(run, other):
    lines = (other / "frames.jsonl").read_text().splitlines()[1:]
    (other / "frames.jsonl").write_text("\n".join(lines))
    assert compare(run, other).causal == np.inf


def test_exported_files_are_compared_but_for_the_path_of_the_run(run, other):
    for folder in (run, other):
        (folder / "exported").mkdir()
        (folder / "exported/note.json").write_text(f'{{"run": "{folder}"}}')
    assert compare(run, other).same
    (other / "exported/note.json").write_text("{}")
    (run / "exported/poses.txt").write_text("0 0 0")
    assert compare(run, other).remarks == ["exported/note.json differs", "exported/poses.txt differs"]


def test_rounding_below_the_tolerance_is_the_same(run, other):
    replace(other / "frames.jsonl", "2.5", "2.5000000000001")
    found = compare(run, other)
    assert found.same and 0 < found.causal < 1e-9


def test_pixels_of_masks_are_counted_and_missing_masks_named(run, other):
    mask = cv2.imread(str(other / "masks/000000.png"), cv2.IMREAD_UNCHANGED)
    mask[0, :3] = 255
    cv2.imwrite(str(other / "masks/000000.png"), mask)
    assert (compare(run, other).pixels, compare(run, other).same) == (3, False)
    (other / "masks/000001.png").unlink()
    assert compare(run, other).remarks == ["1 of masks/ are on one side only"]


def test_vertices_are_compared_but_do_not_decide(run, other):
    replace(other / "mesh.obj", "v 1 0 0.5", "v 1 0 0.75")
    found = compare(run, other)
    assert found.vertices == pytest.approx(0.25) and found.same


def test_what_is_not_finite_is_equal_and_shapes_have_to_agree():
    gap = np.array([1.0, np.nan])
    assert array_difference(gap, gap.copy()) == 0.0
    assert array_difference(gap, np.array([1.0, 2.0])) == np.inf
    assert array_difference(np.zeros((2, 3)), np.zeros((3, 3))) == np.inf


def test_nothing_compared_is_not_the_same(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "frames.jsonl").touch()
    assert not compare(tmp_path / "one", tmp_path / "two").same
