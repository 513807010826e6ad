"""Clips with known truth: what is written is read back, real ones open, wrong ones get one sentence."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from tracking3d.datasets.clip import is_rigid, read_truth
from tracking3d.errors import InputError, OutputError
from tracking3d.evaluation.metrics import mask_iou
from tracking3d.results.files import read_mask
from tracking3d.synthesis.convex_clips import SyntheticSpec, make_demo_clip, synthesize
from tracking3d.video import read_image


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return make_demo_clip(tmp_path_factory.mktemp("demo") / "new" / "clip", seed=3, frames=3, size=(96, 72))


@pytest.fixture
def clip(demo, tmp_path):
    """A copy of the demo clip to damage."""
    return shutil.copytree(demo, tmp_path / "clip")


def edit_poses(clip, change):
    document = json.loads((clip / "poses.json").read_text())
    change(document["frames"])
    (clip / "poses.json").write_text(json.dumps(document))


def test_a_demo_clip_holds_exactly_what_was_synthesized(demo):
    made = synthesize(SyntheticSpec(frames=3, size=(96, 72), seed=3))
    truth = read_truth(demo)
    assert truth.names == ("000000", "000001", "000002")
    for n in range(3):
        assert (read_image(demo / "frames" / f"{n:06d}.png") == made.images[n]).all()
        assert (truth.masks[n].read() == made.masks[n]).all()
        assert truth.T_cam_obj[n] == pytest.approx(made.T_cam_obj[n], abs=1e-15)


def test_a_demo_clip_tells_camera_prompt_and_source(demo):
    made = synthesize(SyntheticSpec(frames=3, size=(96, 72), seed=3))
    camera, init, info = (json.loads((demo / f"{n}.json").read_text()) for n in ("camera", "init", "info"))
    assert np.array(camera["K"]) == pytest.approx(made.K)
    assert (camera["width"], camera["height"]) == (96, 72)
    assert tuple(init["bbox_xywh"]) == made.box
    assert (read_mask(demo / init["mask"]) == made.masks[0]).all()
    assert info["source"] == "synthetic" and info["frames"] == 3


def test_a_demo_clip_has_rough_masks_beside_the_exact_ones(demo):
    exact, rough = (read_mask(demo / folder / "000001.png") for folder in ("masks", "rough_masks"))
    assert 0.7 < mask_iou(exact, rough) < 0.98


def test_the_default_demo_object_turns_by_at_least_sixty_degrees(tmp_path):
    truth = read_truth(make_demo_clip(tmp_path, size=(32, 24)))
    first, last = truth.T_cam_obj[0][:3, :3], truth.T_cam_obj[35][:3, :3]
    assert np.degrees(np.arccos((np.trace(last @ first.T) - 1) / 2)) >= 60


def test_a_clip_that_cannot_be_written_says_so(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="file"):
        make_demo_clip(tmp_path / "file", frames=1, size=(32, 24))


@pytest.mark.parametrize(
    ("name", "frames", "poses", "masks"),
    [
        ("cube_in_hand", 164, 129, 162),
        ("box_in_hand", 114, None, 112),
        ("car_shadow", 40, 0, 40),
        ("temple_ring", 47, 47, 47),
    ],
)
def test_real_clips_open(shared_data, name, frames, poses, masks):
    truth = read_truth(shared_data / name)
    assert len(truth.names) == frames
    assert len(truth.masks) == masks
    assert poses is None or len(truth.T_cam_obj) == poses
    assert truth.masks[0].read().any()


def test_a_clip_without_truth_has_nothing_to_score(shared_data):
    with pytest.raises(InputError, match="neither masks/ nor trusted poses"):
        read_truth(shared_data / "cup_glossy")


def test_frames_are_in_natural_order_and_untrusted_or_unknown_poses_are_left_out(clip):
    for old, new in (("000000", "2"), ("000001", "10"), ("000002", "1")):
        (clip / "frames" / f"{old}.png").rename(clip / "frames" / f"{new}.png")

    def rename(frames):
        frames.update({"2": frames["000000"], "10": dict(frames["000001"], trusted=False)})

    edit_poses(clip, rename)
    truth = read_truth(clip)
    assert truth.names == ("1", "2", "10")
    assert list(truth.T_cam_obj) == [1]
    assert not truth.masks


def test_a_missing_folder_and_a_folder_without_frames_are_named(tmp_path):
    with pytest.raises(InputError, match=r"no clip folder .*nowhere"):
        read_truth(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no images in frames/"):
        read_truth(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"frames": [1]}', "\0\xff"])
def test_a_broken_poses_file_is_named(clip, text):
    (clip / "poses.json").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"poses\.json is not a poses file"):
        read_truth(clip)


@pytest.mark.parametrize(
    "entry", [{}, None, {"R": [[1, 0], [0, 1]], "t": [0, 0, 1]}, {"R": "x", "t": [0, 0, 1]}]
)
def test_a_malformed_pose_is_named_with_its_frame(clip, entry):
    edit_poses(clip, lambda frames: frames.update({"000001": entry}))
    with pytest.raises(InputError, match="frame 000001 needs R"):
        read_truth(clip)


def test_a_trusted_pose_that_is_no_rotation_is_named_and_an_untrusted_one_is_ignored(clip):
    mirror = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
    edit_poses(clip, lambda frames: frames["000002"].update(R=mirror))
    with pytest.raises(InputError, match="frame 000002 is not a rotation"):
        read_truth(clip)
    edit_poses(clip, lambda frames: frames["000002"].update(trusted=False))
    assert sorted(read_truth(clip).T_cam_obj) == [0, 1]


def test_a_damaged_true_mask_is_named(clip):
    (clip / "masks" / "000001.png").write_bytes(b"not an image")
    with pytest.raises(InputError, match=r"000001\.png is not a readable image"):
        read_truth(clip).masks[1].read()


def test_only_finite_rotations_with_a_translation_are_rigid():
    assert is_rigid(np.eye(4))
    for wrong in (np.eye(3), 2 * np.eye(4), np.full((4, 4), np.nan), np.diag([1.0, 1, -1, 1])):
        assert not is_rigid(wrong)
