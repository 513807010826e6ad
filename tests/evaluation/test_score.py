"""Scores of run folders written by hand, against a clip whose truth is simple enough to score by hand."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, fields, replace

import cv2
import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.results.files import write_mask
from tracking3d.testing.synthesis.convex_clips import write_clip
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.datasets.run_answers import answers_of_run, is_refined
from tracking3d_bench.datasets.truth import MaskFile
from tracking3d_bench.evaluation.confidence_scores import frame_difficulties
from tracking3d_bench.evaluation.mask_scores import MaskScores
from tracking3d_bench.evaluation.pose_scores import PoseScores
from tracking3d_bench.evaluation.score import Scores, score, score_run
from tracking3d_bench.evaluation.score_table import format_scores

FRAMES, WIDTH, HEIGHT = 10, 60, 40
CAMERA = Camera.from_fov(WIDTH, HEIGHT)

REQUIRED = {
    "iou_initial_mean",
    "iou_mean",
    "rotation_error_mean_deg",
    "rotation_error_median_deg",
    "rotation_error_anchored_median_deg",
    "share_under_5_deg",
    "share_worse_than_initial",
    "frames",
}


def square(shift):
    """A 10 x 10 square; shifted by s it overlaps the unshifted one with IoU (10 - s) / (10 + s)."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[10:20, 20 + shift : 30 + shift] = True
    return mask


def pose(degrees):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    T[2, 3] = 4
    return T


TRUE_POSES = np.stack([pose(3 * n) for n in range(FRAMES)])


@pytest.fixture
def clip(tmp_path):
    images = np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint8)
    masks = np.stack([square(0)] * FRAMES)
    write_clip(tmp_path / "clip", images, masks, TRUE_POSES, CAMERA, source="hand", note="")
    return tmp_path / "clip"


def line(index, T, **changes):
    fields = {
        "index": index,
        "time": None,
        "name": f"{index:06d}.png",
        "T_cam_obj": T.tolist(),
        "status": "tracked",
        "reason": "",
        "confidence": 1.0,
        "losses": {},
        "iterations": 5,
        "keyframe": False,
        "seconds": 0.5,
        "iou_initial": None,
        "area": 100,
        "revision": False,
        "mask_source": "rendered",
    }
    return json.dumps(fields | changes) + "\n"


def write_masks(run, folder, masks):
    (run / folder).mkdir(exist_ok=True)
    for index, mask in masks.items():
        cv2.imwrite(str(run / folder / f"{index:06d}.png"), mask.astype(np.uint8) * 255)


@pytest.fixture
def write_run(tmp_path):
    """Write a run folder; without arguments a perfect one, but for initial masks that are 2 pixels off."""

    def write(indices=range(FRAMES), poses=TRUE_POSES, masks=None, initial=None, changes=None, **description):
        run = tmp_path / "run"
        run.mkdir()
        document = {
            "format": "tracking3d-run",
            "format_version": 2,
            "state": "finished",
            "config": {},
            "camera": asdict(CAMERA),
            "counts": {},
            "timings": {},
            "skipped": [],
        }
        (run / "run.json").write_text(json.dumps(document | description))
        lines = [line(n, poses[n], **(changes or {}).get(n, {})) for n in indices]
        (run / "frames.jsonl").write_text("".join(lines))
        write_masks(run, "masks", {n: square(0) for n in indices} | (masks or {}))
        write_masks(run, "initial_masks", {n: square(2) for n in indices} if initial is None else initial)
        return run

    return write


def test_a_perfect_run_has_full_marks(write_run, clip):
    scores = score_run(write_run(), clip)
    assert scores.iou_mean == 1.0
    assert scores.iou_initial_mean == pytest.approx(8 / 12)
    assert scores.iou_gain_percent == pytest.approx(50)
    assert scores.rotation_error_mean_deg == pytest.approx(0, abs=1e-9)
    assert scores.rotation_error_anchored_median_deg == pytest.approx(0, abs=1e-9)
    assert scores.share_under_5_deg == 1.0
    assert scores.share_worse_than_initial == 0.0
    assert (scores.frames, scores.frames_missing, scores.frames_lost) == (10, 0, 0)
    assert (scores.frames_with_mask, scores.frames_with_pose) == (9, 10)
    assert scores.seconds_per_frame == 0.5


def test_the_scores_are_json_with_the_promised_keys(write_run, clip):
    document = json.loads(json.dumps(asdict(score_run(write_run(), clip)), allow_nan=False))
    assert document.keys() >= REQUIRED


def test_another_object_frame_and_scale_are_no_error(write_run, clip):
    poses = TRUE_POSES @ pose(77)
    poses[:, :3, 3] *= 5
    assert score_run(write_run(poses=poses), clip).rotation_error_max_deg == pytest.approx(0, abs=1e-9)


def test_mask_means_leave_out_the_first_frame_and_count_every_other(write_run, clip):
    run = write_run(masks={0: square(9), 1: square(5), 2: square(3), 3: square(2)})
    scores = score_run(run, clip)
    assert scores.iou_mean == pytest.approx((5 / 15 + 7 / 13 + 8 / 12 + 6) / 9)
    # Frames 1 and 2 are worse than their initial mask, frame 3 equals it.
    assert scores.share_worse_than_initial == pytest.approx(2 / 9)


def test_a_frame_without_initial_mask_has_an_initial_iou_of_zero(write_run, clip):
    scores = score_run(write_run(initial={n: square(0) for n in range(4)}), clip)
    assert scores.iou_initial_mean == pytest.approx(3 / 9)
    assert scores.share_worse_than_initial == 0.0


def test_no_initial_mask_is_right_where_the_object_is_out_of_sight(write_run, clip):
    empty = np.zeros((HEIGHT, WIDTH), bool)
    cv2.imwrite(str(clip / "masks" / "000006.png"), empty.astype(np.uint8))
    initial = {n: square(0) for n in range(FRAMES) if n != 6}
    assert score_run(write_run(masks={6: empty}, initial=initial), clip).iou_initial_mean == 1.0


def test_no_initial_mask_at_all_leaves_the_gain_unknown(write_run, clip):
    scores = score_run(write_run(initial={}), clip)
    assert scores.iou_initial_mean == 0.0
    assert scores.iou_gain_percent is None


def test_one_wrong_rotation_shows_in_mean_maximum_and_share_but_not_in_the_median(write_run, clip):
    poses = TRUE_POSES.copy()
    poses[4] = pose(12 + 30)
    scores = score_run(write_run(poses=poses), clip)
    assert scores.rotation_error_mean_deg == pytest.approx(3)
    assert scores.rotation_error_max_deg == pytest.approx(30)
    assert scores.rotation_error_median_deg == pytest.approx(0, abs=1e-9)
    assert scores.share_under_5_deg == pytest.approx(0.9)


def test_anchored_errors_inherit_the_first_frames_error_and_aligned_ones_do_not(write_run, clip):
    poses = TRUE_POSES.copy()
    poses[0] = pose(20)
    scores = score_run(write_run(poses=poses), clip)
    assert scores.rotation_error_anchored_median_deg == pytest.approx(20)
    assert scores.rotation_error_median_deg == pytest.approx(0, abs=1e-9)
    assert scores.rotation_error_consecutive_median_deg == pytest.approx(0, abs=1e-9)


def test_a_lost_frame_is_not_under_five_degrees_though_its_pose_is_right(write_run, clip):
    scores = score_run(write_run(changes={3: {"status": "lost"}, 4: {"status": "uncertain"}}), clip)
    assert scores.share_under_5_deg == pytest.approx(0.9)
    assert scores.rotation_error_mean_deg == pytest.approx(0, abs=1e-9)
    assert scores.frames_lost == 1


@pytest.mark.parametrize("what", ["missing", "nan"])
def test_a_frame_without_a_usable_pose_is_half_a_turn_off(write_run, clip, what):
    poses = TRUE_POSES.copy()
    poses[4] = {"missing": poses[4], "nan": np.full((4, 4), np.nan)}[what]
    indices = [n for n in range(FRAMES) if what != "missing" or n != 4]
    scores = score_run(write_run(indices, poses), clip)
    assert scores.rotation_error_mean_deg == pytest.approx(18)
    assert scores.rotation_error_median_deg == pytest.approx(0, abs=1e-9)
    assert scores.share_under_5_deg == pytest.approx(0.9)
    assert scores.rotation_error_consecutive_median_deg == pytest.approx(0, abs=1e-9)


def test_a_pose_that_mirrors_is_refused_with_its_frame(write_run, clip):
    poses = TRUE_POSES.copy()
    poses[4] = np.diag([1, 1, -1, 1])
    with pytest.raises(InputError, match="frame 4 is not a rotation"):
        score_run(write_run(range(FRAMES), poses), clip)


def test_a_run_without_any_usable_pose_is_half_a_turn_off_throughout(write_run, clip):
    scores = score_run(write_run(poses=np.full((FRAMES, 4, 4), np.nan)), clip)
    assert scores.rotation_error_median_deg == scores.rotation_error_anchored_median_deg == 180
    assert scores.rotation_error_consecutive_median_deg is None
    assert scores.share_under_5_deg == 0


def test_frames_that_an_interrupted_run_never_came_to_count_as_wrong(write_run, clip):
    scores = score_run(write_run(range(4), state="interrupted"), clip)
    assert scores.iou_mean == pytest.approx(3 / 9)
    assert scores.iou_initial_mean == pytest.approx(3 / 9 * 8 / 12)
    assert scores.share_under_5_deg == pytest.approx(0.4)
    assert (scores.frames, scores.frames_missing) == (10, 6)


def test_a_frame_that_was_skipped_counts_as_wrong(write_run, clip):
    skipped = [{"index": 5, "reason": "damaged"}]
    scores = score_run(write_run([n for n in range(FRAMES) if n != 5], skipped=skipped), clip)
    assert scores.iou_mean == pytest.approx(8 / 9)
    assert scores.share_worse_than_initial == 0.0
    assert scores.share_under_5_deg == pytest.approx(0.9)


def test_only_the_frames_a_run_was_asked_for_count(write_run, clip):
    scores = score_run(write_run(range(2, 9, 3), masks={2: square(9)}, selection="2:9:3"), clip)
    assert (scores.frames, scores.frames_missing) == (3, 0)
    assert scores.iou_mean == 1.0  # frame 2 is the first of this run: its mask was given
    assert scores.frames_with_mask == 2
    assert scores.share_under_5_deg == 1.0


def test_a_later_line_replaces_an_earlier_one(write_run, clip):
    wrong = TRUE_POSES.copy()
    wrong[7] = pose(150)
    run = write_run(poses=wrong)
    with (run / "frames.jsonl").open("a") as file:
        file.write(line(7, TRUE_POSES[7], revision=True))
    assert score_run(run, clip).rotation_error_max_deg == pytest.approx(0, abs=1e-9)


@pytest.fixture
def refined_run(write_run):
    """A run whose causal answers drift by 2 degrees a frame and 3 pixels of mask; the refined ones are perfect."""
    drifted = np.stack([pose(5 * n) for n in range(FRAMES)])
    run = write_run(poses=drifted, refinement={"state": "finished", "seconds": 3.0, "frames": 8})
    with (run / "frames.jsonl").open("a") as file:
        file.writelines(line(n, TRUE_POSES[n], refined=True, seconds=0.1) for n in range(1, 9))
    (run / "causal").mkdir()
    write_masks(run / "causal", "masks", {n: square(3) for n in range(1, 9)})
    return run


def test_a_refined_run_is_scored_by_its_refined_answers(refined_run, clip):
    scores = score_run(refined_run, clip)
    assert scores.iou_mean == 1.0
    # Frame 9 was not refined: its causal answer, 18 degrees off, stands.
    assert scores.rotation_error_max_deg == pytest.approx(18)
    assert scores.rotation_error_median_deg == pytest.approx(0, abs=1e-9)
    # Half a second each for the causal answers and 3 for refining eight frames.
    assert scores.seconds_per_frame == pytest.approx((10 * 0.5 + 3.0) / 10)
    assert scores.seconds_per_frame_median == pytest.approx(0.5 + 3.0 / 8)


def test_the_causal_answers_of_a_refined_run_are_scored_when_asked_for(refined_run, clip):
    scores = score_run(refined_run, clip, refined=False)
    assert scores.iou_mean == pytest.approx((8 * 7 / 13 + 1) / 9)
    assert scores.rotation_error_max_deg == pytest.approx(10)
    assert scores.seconds_per_frame == scores.seconds_per_frame_median == 0.5


def test_a_run_without_refined_answers_is_the_same_either_way(write_run, clip):
    run = write_run(masks={1: square(5)})
    assert score_run(run, clip) == score_run(run, clip, refined=False)
    assert not is_refined(run)


def test_the_return_to_the_first_view_is_judged_by_the_turn_from_first_to_last(write_run, clip):
    angles = [0, 20, 40, 60, 80, 80, 60, 40, 20, 0]
    document = json.loads((clip / "poses.json").read_text())
    for n, angle in enumerate(angles):
        document["frames"][f"{n:06d}"]["R"] = pose(angle)[:3, :3].tolist()
    (clip / "poses.json").write_text(json.dumps(document))
    drifting = np.stack([pose(angle + 0.7 * n) for n, angle in enumerate(angles)])
    assert score_run(write_run(poses=drifting), clip).rotation_error_return_deg == pytest.approx(6.3)


@pytest.mark.parametrize("gone", [0, 9])
def test_without_its_first_or_last_pose_a_return_is_half_a_turn_off(write_run, clip, gone):
    angles = [0, 20, 40, 60, 80, 80, 60, 40, 20, 0]
    document = json.loads((clip / "poses.json").read_text())
    for n, angle in enumerate(angles):
        document["frames"][f"{n:06d}"]["R"] = pose(angle)[:3, :3].tolist()
    (clip / "poses.json").write_text(json.dumps(document))
    poses = np.stack([pose(angle) for angle in angles])
    poses[gone] = np.nan
    assert score_run(write_run(poses=poses), clip).rotation_error_return_deg == 180


def test_a_clip_that_ends_elsewhere_or_never_went_away_has_no_return(write_run, clip):
    run = write_run()
    assert score_run(run, clip).rotation_error_return_deg is None  # it ends 27 degrees away
    document = json.loads((clip / "poses.json").read_text())
    for entry in document["frames"].values():
        entry["R"] = np.eye(3).tolist()
    (clip / "poses.json").write_text(json.dumps(document))
    assert score_run(run, clip).rotation_error_return_deg is None


def test_the_share_under_a_limit_is_averaged_over_the_limit(write_run, clip):
    poses = TRUE_POSES.copy()
    poses[4] = pose(12 + 5)  # counts for three quarters of the limits up to 20 degrees
    poses[5] = pose(15 + 30)
    scores = score_run(write_run(poses=poses, changes={6: {"status": "lost"}}), clip)
    assert scores.rotation_auc_20_deg == pytest.approx((7 + 0.75) / 10)


def test_lost_and_missing_frames_are_counted_together_once(write_run, clip):
    scores = score_run(write_run(range(8), changes={n: {"status": "lost"} for n in (1, 2, 3)}), clip)
    assert (scores.frames_lost, scores.frames_missing) == (3, 2)
    assert scores.share_lost == pytest.approx(0.5)


def test_turns_about_an_axis_of_symmetry_do_not_count(write_run, clip):
    info = json.loads((clip / "info.json").read_text())
    info["symmetry_axis"] = {"direction": [0, 2, 0], "point": [0, 0, 0]}
    (clip / "info.json").write_text(json.dumps(info))
    stands_still = np.stack([pose(0)] * FRAMES)
    leaning = stands_still.copy()
    leaning[4, :3, :3] = Rotation.from_rotvec([np.radians(8), 0, 0]).as_matrix()
    plain = write_run(poses=leaning)
    scores = score_run(plain, clip)
    assert scores.rotation_error_max_deg == pytest.approx(8)
    assert scores.rotation_error_mean_deg == pytest.approx(0.8)
    assert scores.rotation_error_anchored_median_deg == pytest.approx(0, abs=1e-6)
    assert scores.rotation_error_consecutive_median_deg == pytest.approx(0, abs=1e-6)
    assert scores.share_axis_named == 0 and scores.axis_tilt_mean_deg is None
    plain.rename(plain.parent / "plain")
    named = {n: {"free_axis": (0.0, -1.0, 0.0)} for n in (3, 4)}
    scores = score_run(write_run(poses=leaning, changes=named), clip)
    assert scores.share_axis_named == pytest.approx(2 / FRAMES)
    assert scores.axis_tilt_mean_deg == pytest.approx(4) and scores.axis_tilt_max_deg == pytest.approx(8)


@pytest.mark.parametrize("axis", [{}, {"direction": [0, 0, 0]}, {"direction": [1, 2]}, {"direction": "y"}, 3])
def test_an_axis_that_is_none_is_refused(write_run, clip, axis):
    info = json.loads((clip / "info.json").read_text())
    (clip / "info.json").write_text(json.dumps(info | {"symmetry_axis": axis}))
    with pytest.raises(InputError, match="symmetry_axis"):
        score_run(write_run(), clip)


def test_confidence_that_ranks_wrong_frames_below_right_ones_has_all_of_the_area(write_run, clip):
    poses = TRUE_POSES.copy()
    poses[4:6] = pose(100)
    low = {n: {"confidence": 0.2} for n in (4, 5)}
    assert score_run(write_run(poses=poses, changes=low), clip).confidence_auc == 1.0


def test_a_line_that_was_cut_off_is_a_missing_frame(write_run, clip):
    run = write_run()
    lines = (run / "frames.jsonl").read_text()
    (run / "frames.jsonl").write_text(lines[:-40])
    assert score_run(run, clip).frames_missing == 1


def test_only_trusted_poses_are_scored(write_run, clip):
    document = json.loads((clip / "poses.json").read_text())
    for name in ("000004", "000005"):
        document["frames"][name]["trusted"] = False
    (clip / "poses.json").write_text(json.dumps(document))
    poses = TRUE_POSES.copy()
    poses[4:6] = pose(100)
    scores = score_run(write_run(poses=poses), clip)
    assert scores.frames_with_pose == 8
    assert scores.rotation_error_max_deg == pytest.approx(0, abs=1e-9)


def unknown(scores, group):
    """The measures of a group that are None, and those that are not."""
    names = [field.name for field in fields(group) if not field.name.startswith("frames_with")]
    return [getattr(scores, name) is None for name in names]


def test_without_true_poses_the_pose_figures_are_unknown(write_run, clip):
    (clip / "poses.json").unlink()
    scores = score_run(write_run(), clip)
    assert all(unknown(scores, PoseScores)) and scores.frames_with_pose == 0
    assert not any(unknown(scores, MaskScores))


def test_without_true_masks_the_mask_figures_are_unknown(write_run, clip):
    for mask in (clip / "masks").iterdir():
        mask.unlink()
    scores = score_run(write_run(), clip)
    assert all(unknown(scores, MaskScores)) and scores.frames_with_mask == 0
    # The clip does not return to its first view, and the object has no axis.
    assert unknown(scores, PoseScores).count(True) == 3


def test_frames_without_a_true_mask_do_not_count_for_the_masks(write_run, clip):
    (clip / "masks" / "000003.png").unlink()
    scores = score_run(write_run(masks={3: square(9)}), clip)
    assert (scores.iou_mean, scores.frames_with_mask) == (1.0, 8)


def test_an_object_that_is_truly_out_of_sight_is_matched_by_an_empty_mask(write_run, clip):
    empty = np.zeros((HEIGHT, WIDTH), bool)
    cv2.imwrite(str(clip / "masks" / "000006.png"), empty.astype(np.uint8))
    assert score_run(write_run(masks={6: empty}), clip).iou_mean == 1.0


def test_a_folder_that_is_not_a_run_or_not_a_clip_is_named(write_run, clip, tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        score_run(tmp_path / "nowhere", clip)
    with pytest.raises(InputError, match="clip"):
        score_run(clip, clip)
    with pytest.raises(InputError, match="nowhere"):
        score_run(write_run(), tmp_path / "nowhere")


def test_broken_files_are_named(write_run, clip):
    run = write_run()
    lines = (run / "frames.jsonl").read_text()
    (run / "frames.jsonl").write_text(lines.replace('"index": 3', '"index": ', 1))
    with pytest.raises(InputError, match=r"(?i)line 4 of .*frames\.jsonl"):
        score_run(run, clip)
    (run / "run.json").write_text("{")
    with pytest.raises(InputError, match=r"run\.json"):
        score_run(run, clip)


def test_a_run_of_something_else_has_no_frame_in_common(write_run, clip):
    with pytest.raises(InputError, match="has no frame of the clip"):
        score_run(write_run(range(100, 102), poses={100: pose(0), 101: pose(0)}), clip)


def test_masks_of_another_size_are_named_with_their_frame(write_run, clip):
    with pytest.raises(InputError, match=r"Frame 2: the mask of .*run is 8 x 6 pixels"):
        score_run(write_run(masks={2: np.ones((6, 8), bool)}), clip)


def test_a_mask_that_is_missing_from_the_run_is_named(write_run, clip):
    run = write_run()
    (run / "masks" / "000003.png").unlink()
    with pytest.raises(InputError, match=r"000003\.png is not a readable image"):
        score_run(run, clip)


@pytest.mark.parametrize("selection", ["5:2", "all", 7])
def test_a_selection_that_makes_no_sense_is_named(write_run, clip, selection):
    with pytest.raises(InputError, match=r"frames='|run\.json is damaged: selection is 7"):
        score_run(write_run(selection=selection), clip)


def test_the_table_shows_the_figures_and_names_what_is_unknown(write_run, clip):
    (clip / "poses.json").unlink()
    scores = score_run(write_run(), clip)
    console = Console(record=True, width=100, file=io.StringIO())
    console.print(format_scores(scores))
    text = console.export_text()
    assert isinstance(scores, Scores)
    assert "IoU of the estimates, mean" in text and "1.000" in text and "50.0 %" in text
    assert "unknown" in text


def test_a_real_clip_scores_its_own_truth_perfectly(write_run, shared_data, tmp_path):
    from tracking3d_bench.datasets.clip import read_truth

    truth = read_truth(shared_data / "cube_in_hand")
    wanted = range(0, 164, 20)
    poses = {n: truth.T_cam_obj.get(n, np.full((4, 4), np.nan)) for n in wanted}
    masks = {n: truth.masks[n].read() for n in wanted if n in truth.masks}
    run = write_run(
        wanted, poses, masks=masks, initial=masks, selection="0:164:20", camera=asdict(truth.camera)
    )
    scores = score_run(run, shared_data / "cube_in_hand")
    assert scores.iou_mean == scores.iou_initial_mean == 1.0
    assert scores.rotation_error_max_deg == pytest.approx(0, abs=1e-6)


def edit_poses(clip, edit):
    file = clip / "poses.json"
    document = json.loads(file.read_text())
    for entry in document["frames"].values():
        edit(entry)
    file.write_text(json.dumps(document))


def of_rotations(scores):
    return [value for name, value in asdict(scores).items() if name.startswith(("rotation_", "share_under"))]


def of_translations(scores):
    return [value for name, value in asdict(scores).items() if name.startswith("translation_")]


@pytest.mark.parametrize(
    "unknown", [{"t": [0, 0, 0]}, {"t": None}, {"t": [0, 0, -4]}], ids=["zero", "none", "behind the camera"]
)
def test_a_truth_of_rotations_alone_scores_rotations(write_run, clip, unknown):
    edit_poses(clip, lambda entry: entry.update(unknown))
    poses = TRUE_POSES.copy()
    poses[4] = poses[4] @ pose(40)
    scores = score_run(write_run(poses=poses), clip)
    assert scores.rotation_error_max_deg == pytest.approx(40)
    assert scores.rotation_error_median_deg == pytest.approx(0, abs=1e-6)
    assert scores.share_under_5_deg == 0.9
    assert set(of_translations(scores)) == {None}
    assert scores.frames_with_pose == FRAMES


def test_a_truth_of_translations_alone_scores_translations(write_run, clip):
    edit_poses(clip, lambda entry: entry.pop("R"))
    poses = TRUE_POSES.copy()
    poses[4, 0, 3] += 1
    scores = score_run(write_run(poses=poses), clip)
    assert scores.translation_share_under_5_percent == 0.9
    assert scores.translation_error_median_percent == pytest.approx(0, abs=1e-6)
    assert set(of_rotations(scores)) == {None}
    assert scores.confidence_calibration_error is not None  # by the masks


def test_of_each_frame_counts_what_is_known_of_it(write_run, clip):
    turned = iter(range(FRAMES))
    edit_poses(clip, lambda entry: entry.pop("R" if next(turned) < 4 else "t"))
    poses = TRUE_POSES.copy()
    poses[2, :3, :3] = pose(40)[:3, :3]  # its rotation is not known
    poses[7, 0, 3] += 1  # its translation is not known
    scores = score_run(write_run(poses=poses), clip)
    assert scores.rotation_error_max_deg == pytest.approx(0, abs=1e-6)
    assert scores.translation_error_mean_percent == pytest.approx(0, abs=1e-6)


def test_an_object_that_stays_in_its_place_has_translation_errors(write_run, clip):
    scores = score_run(write_run(), clip)  # all true positions are equal
    assert scores.translation_error_median_percent == pytest.approx(0, abs=1e-6)
    assert scores.translation_share_under_5_percent == 1


def test_a_single_known_pose_is_scored(write_run, clip):
    edit_poses(clip, lambda entry: entry.update(trusted=entry["R"] == TRUE_POSES[5, :3, :3].tolist()))
    scores = score_run(write_run(), clip)
    assert scores.frames_with_pose == 1
    assert scores.rotation_error_mean_deg == pytest.approx(0, abs=1e-6)
    assert scores.translation_error_mean_percent == pytest.approx(0, abs=1e-6)
    assert scores.rotation_error_consecutive_median_deg is None


def test_masks_or_poses_alone_are_scored(write_run, clip):
    run = write_run()
    (clip / "poses.json").rename(clip / "poses.aside")
    alone = score_run(run, clip)
    assert (alone.iou_mean, alone.rotation_error_mean_deg, alone.frames_with_pose) == (1.0, None, 0)
    (clip / "poses.aside").rename(clip / "poses.json")
    (clip / "masks").rename(clip / "aside")
    alone = score_run(run, clip)
    assert alone.iou_mean is None
    assert alone.rotation_error_mean_deg == pytest.approx(0, abs=1e-6)


def test_a_pose_of_neither_rotation_nor_translation_is_refused(write_run, clip):
    edit_poses(clip, lambda entry: (entry.pop("R"), entry.pop("t")))
    with pytest.raises(InputError, match=r"poses\.json: frame 000000 needs R"):
        score_run(write_run(), clip)


def shifted_run(write_run, by, count=FRAMES, **description):
    """A perfect run whose frames are counted from ``by``."""
    run = write_run(range(count), **description)
    lines = [json.loads(text) for text in (run / "frames.jsonl").read_text().splitlines()]
    (run / "frames.jsonl").write_text(
        "".join(json.dumps(one | {"index": one["index"] + by}) + "\n" for one in lines)
    )
    for folder in ("masks", "initial_masks"):
        for file in sorted((run / folder).iterdir(), reverse=True):
            file.rename(file.with_name(f"{int(file.stem) + by:06d}.png"))
    return run


def test_a_run_of_other_frames_is_refused_with_what_to_do(write_run, clip):
    run = shifted_run(write_run, 8, selection="8:18")
    with pytest.raises(
        InputError,
        match=r"has only 2 frames of the clip clip: its 10 frames are 8 to 17, .* 0 to 9; .*--offset",
    ):
        score_run(run, clip)


def test_a_run_that_shares_no_frame_is_refused(write_run, clip):
    with pytest.raises(InputError, match="has no frame of the clip clip: its 10 frames are 150 to 159"):
        score_run(shifted_run(write_run, 150, selection="150:160"), clip)


@pytest.mark.parametrize("by", [8, 150])
def test_an_offset_says_which_frame_is_which(write_run, clip, by):
    run = shifted_run(write_run, by, selection=f"{by}:{by + FRAMES}")
    truth = read_truth(clip)
    answers = answers_of_run(run, truth, offset=-by)
    assert answers.asked == range(FRAMES)
    assert (
        answers.matched(len(truth.frames))
        == "10 of 10 estimated frames match frames of the clip, 0 to 9 of its 10"
    )
    scores = score(answers, truth)
    assert (scores.frames_missing, scores.iou_mean) == (0, 1.0)
    assert scores.iou_initial_mean == pytest.approx(8 / 12)
    assert scores.rotation_error_max_deg == pytest.approx(0, abs=1e-6)


def test_frames_that_an_offset_moves_out_of_the_clip_are_not_asked_for(write_run, clip):
    answers = answers_of_run(write_run(range(0, 10, 2), selection="0:10:2"), read_truth(clip), offset=-3)
    assert list(answers.asked) == [1, 3, 5]
    assert sorted(answers.answered) == [1, 3, 5]


def test_a_run_of_frames_of_another_size_is_refused(write_run, clip):
    camera = asdict(CAMERA) | {"width": 640, "height": 480}
    with pytest.raises(InputError, match="frames of 640 x 480 pixels, but the clip clip has 60 x 40"):
        score_run(write_run(camera=camera), clip)


def test_an_interrupted_run_is_scored_though_it_has_few_frames_of_the_clip(write_run, clip):
    assert score_run(write_run(range(2)), clip).frames_missing == 8


def test_the_share_of_answers_of_its_own_is_told_beside_the_iou(write_run, clip):
    sources = {
        n: {"mask_source": "initial" if n < 7 else "fused" if n < 9 else "rendered"} for n in range(FRAMES)
    }
    scores = score_run(write_run(changes=sources), clip)
    assert scores.share_own_masks == pytest.approx(3 / 9)  # the given frame does not count
    assert "not the unchanged initial mask" in text_of(scores)


def test_whose_masks_they_are_is_unknown_in_runs_of_older_versions(write_run, clip):
    older = {n: {"mask_source": None} for n in range(FRAMES)}
    assert score_run(write_run(changes=older), clip).share_own_masks is None


def test_stages_are_means_and_come_after_the_whole(write_run, clip):
    stages = {"decode": 0.1, "track": 0.2, "encode": 0.05, "solve": 0.1, "map": 0.0, "write": 0.05}
    scores = score_run(write_run(changes={n: {"stages": stages} for n in range(FRAMES)}), clip)
    assert {stage: getattr(scores, f"seconds_{stage}") for stage in stages} == pytest.approx(stages)
    text = text_of(scores)
    assert text.index("seconds per frame, mean") < text.index("stage decode") < text.index("stage write")


def text_of(scores):
    console = Console(file=io.StringIO(), width=200)
    console.print(format_scores(scores))
    return console.file.getvalue()


def test_a_frame_is_harder_with_less_texture_more_hidden_and_faster_motion(tmp_path):
    """One texture, half of it hidden in frame 2, and 20 degrees between frames 2 and 3."""
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8), (160, 120))
    faint = np.round(image / 16).astype(np.uint8)
    mask = np.zeros((120, 160), bool)
    mask[20:100, 20:140] = True
    half = mask.copy()
    half[:, 80:] = False
    T = np.tile(np.eye(4), (4, 1, 1))
    T[3, :3, :3] = Rotation.from_rotvec([0, np.radians(20), 0]).as_matrix()
    write_clip(
        tmp_path, np.stack([image, faint, image, image]), np.stack([mask] * 4), T, Camera.from_fov(160, 120),
        source="t", note="",
    )  # fmt: skip
    truth = read_truth(tmp_path)
    shown = tmp_path / "half.png"
    write_mask(shown, half)
    hard = frame_difficulties(replace(truth, visible_masks={2: MaskFile(shown)}))
    assert hard[0] < hard[1]
    assert hard[2] - hard[0] == pytest.approx(2, abs=0.5)
    assert hard[3] - hard[0] == pytest.approx(2)
