"""Clips with known truth: what is written is read back, real ones open, wrong ones get one sentence."""

from __future__ import annotations

import io
import json
import shutil

import cv2
import numpy as np
import pytest

from tracking3d.errors import InputError, OutputError
from tracking3d.geometry.alignment import is_rigid
from tracking3d.results.files import read_mask, write_mask
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, make_demo_clip, synthesize
from tracking3d.video import read_image
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.evaluation.metrics import mask_iou


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


@pytest.mark.parametrize(
    ("off", "message"), [(0.0027, ""), (0.018, ""), (0.03, "frame 000002 is not a rotation")]
)
def test_a_pose_that_is_nearly_a_rotation_is_replaced_by_the_nearest_one(clip, caplog, off, message):
    sheared = np.eye(3)
    sheared[0, 1] = off
    edit_poses(clip, lambda frames: frames["000002"].update(R=sheared.tolist()))
    if message:
        with pytest.raises(InputError, match=message):
            read_truth(clip)
        return
    for _ in range(2):
        T = read_truth(clip).T_cam_obj[2]
    assert is_rigid(T, 1e-12) and np.abs(T[:3, :3] - sheared).max() < off
    assert [record.message.endswith("the nearest ones are used.") for record in caplog.records] == [True]


def edit(file, **changes):
    document = json.loads(file.read_text()) if file.exists() else {}
    file.write_text(json.dumps(document | changes))


def test_a_demo_clip_has_name_box_camera_and_rough_masks(demo):
    made = synthesize(SyntheticSpec(frames=3, size=(96, 72), seed=3))
    truth = read_truth(demo)
    assert truth.name == "clip" and truth.box == made.box
    assert truth.camera is not None
    np.testing.assert_allclose(truth.camera.K, made.K)
    assert (truth.camera.width, truth.camera.height) == (96, 72)
    assert (truth.initial_masks[1].read() == read_mask(demo / "rough_masks/000001.png")).all()
    assert truth.given_camera is truth.mesh is truth.points is truth.millimetres is None
    assert truth.symmetries.tolist() == [np.eye(4).tolist()]
    assert not truth.visible_masks and not truth.depth and not truth.boxes


def test_the_name_is_that_of_the_folder_however_it_is_given(clip, monkeypatch):
    monkeypatch.chdir(clip)
    assert read_truth(clip / ".").name == read_truth(clip / "masks" / "..").name == "clip"


def test_visible_masks_are_kept_beside_the_whole_ones_and_the_box_is_of_what_is_seen(clip):
    seen = np.zeros((72, 96), bool)
    seen[20:30, 40:60] = True
    (clip / "visible_masks").mkdir()
    write_mask(clip / "visible_masks/000000.png", seen)
    (clip / "init.json").unlink()
    truth = read_truth(clip)
    assert list(truth.visible_masks) == [0] and len(truth.masks) == 3 and not truth.is_visible_part(0)
    assert (truth.visible_masks[0].read() == seen).all()
    assert truth.box == (40, 20, 20, 10)
    shutil.rmtree(clip / "masks")
    truth = read_truth(clip)
    assert (truth.masks[0].read() == seen).all() and truth.is_visible_part(0)


def test_the_box_is_that_of_init_json_or_else_of_the_first_mask(clip):
    around = read_truth(clip).box
    edit(clip / "init.json", bbox_xywh=[1, 2.5, 3, 4])
    assert read_truth(clip).box == (1, 2.5, 3, 4)
    edit(clip / "init.json", frame=2)
    assert read_truth(clip).box == around
    (clip / "init.json").unlink()
    assert read_truth(clip).box == around


def test_the_key_of_an_earlier_version_is_refused(clip):
    file = clip / "camera.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"told": False}))
    with pytest.raises(InputError, match=r"an earlier version of tracking3d.* rename it to given"):
        read_truth(clip)


def test_the_true_camera_may_differ_from_the_one_that_a_tracker_is_told(clip):
    told = read_truth(clip).camera
    assert told is not None
    edit(clip / "truth_camera.json", K=[[90, 0, 40], [0, 91, 30], [0, 0, 1]], width=96, height=72)
    truth = read_truth(clip)
    assert truth.camera is not None and truth.given_camera is not None
    assert (truth.camera.fx, truth.camera.fy) == (90, 91)
    assert (truth.given_camera.K == told.K).all()


@pytest.mark.parametrize(
    ("unit", "millimetres"), [("metres", 1000), ("centimetres (about)", 10), ("inches", None)]
)
def test_the_unit_of_the_poses_is_known_by_its_name(clip, unit, millimetres):
    edit(clip / "poses.json", units=unit)
    assert read_truth(clip).millimetres == millimetres
    edit(clip / "info.json", millimetres=25.4)
    assert read_truth(clip).millimetres == 25.4


def test_a_count_of_depth_is_a_millimetre_or_what_the_camera_says(clip):
    (clip / "depth").mkdir()
    cv2.imwrite(str(clip / "depth/000001.png"), np.full((72, 96), 250, np.uint16))

    def depth():
        (image,) = read_truth(clip).depth.items()
        return image[0], float(image[1].read()[5, 5])

    assert depth() == pytest.approx((1, 0.25))
    edit(clip / "info.json", millimetres=10)
    assert depth() == pytest.approx((1, 25))
    edit(clip / "camera.json", depth_scale=0.5)
    assert depth() == pytest.approx((1, 125))


def test_a_mesh_and_symmetries_come_along(clip):
    (clip / "mesh.obj").write_text("v 0 0 0\nv 3 0 0\nv 0 4 0\nf 1 2 3\n")
    flip = np.diag([-1.0, -1, 1, 1])
    edit(clip / "info.json", symmetries=[flip.tolist(), np.eye(4).tolist()])
    truth = read_truth(clip)
    assert truth.mesh is not None and truth.mesh.read().extents == pytest.approx([3, 4, 0])
    assert truth.symmetries.tolist() == [np.eye(4).tolist(), flip.tolist()]


def test_points_come_along_and_may_be_all_that_is_known(clip):
    positions = np.arange(12.0).reshape(3, 2, 2)
    visible = np.array([[1, 1], [1, 0], [0, 0]], bool)
    positions[2] = np.nan
    np.savez(clip / "points.npz", positions=positions, visible=visible)
    shutil.rmtree(clip / "masks")
    (clip / "poses.json").unlink()
    points = read_truth(clip).points
    assert points is not None
    np.testing.assert_array_equal(points.positions, positions)
    np.testing.assert_array_equal(points.visible, visible)


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({}, "cannot be read as positions and visible"),
        ({"positions": np.zeros((3, 2, 2))}, "cannot be read as positions and visible"),
        ({"positions": np.array([{}]), "visible": np.ones(1)}, "cannot be read as positions and visible"),
        ({"positions": np.zeros((2, 2, 2)), "visible": np.ones((2, 2))}, "the clip's 3 frames"),
        ({"positions": np.zeros((3, 2, 3)), "visible": np.ones((3, 2))}, "the clip's 3 frames"),
        ({"positions": np.full((3, 2, 2), np.nan), "visible": np.ones((3, 2))}, "not finite"),
    ],
)
def test_points_of_another_form_are_named(clip, arrays, reason):
    np.savez(clip / "points.npz", **arrays)
    with pytest.raises(InputError, match=reason) as caught:
        read_truth(clip)
    assert str(clip / "points.npz") in str(caught.value)


@pytest.mark.parametrize("data", [b"", b"not an archive", b"PK\x03\x04truncated", b"one array"])
def test_points_that_are_no_archive_are_named(clip, data):
    if data == b"one array":
        stream = io.BytesIO()
        np.save(stream, np.zeros(3))
        data = stream.getvalue()
    (clip / "points.npz").write_bytes(data)
    with pytest.raises(InputError, match=r"points\.npz cannot be read as positions and visible"):
        read_truth(clip)


@pytest.mark.parametrize(
    ("file", "changes", "reason"),
    [
        ("camera.json", {"K": [[1, 0], [0, 1]]}, "K must be 3 x 3 numbers"),
        ("camera.json", {"K": [[0, 0, 1], [0, 1, 1], [0, 0, 1]]}, "positive focal lengths"),
        ("camera.json", {"K": [[9, 2, 1], [0, 9, 1], [0, 0, 1]]}, "K must be fx 0 cx"),
        ("camera.json", {"K": [[9, 0, 1], [0, 9, 1], [0, 1, 1]]}, "K must be fx 0 cx"),
        ("camera.json", {"width": "wide"}, "width and height must be whole"),
        ("truth_camera.json", {}, "K must be 3 x 3 numbers"),
        ("init.json", {"bbox_xywh": [1, 2, 3]}, "bbox_xywh must be four numbers"),
        ("init.json", {"bbox_xywh": None}, "bbox_xywh must be four numbers"),
        ("info.json", {"millimetres": 0}, "millimetres must be a positive number, not 0"),
        ("info.json", {"millimetres": "10"}, "millimetres must be a positive number, not '10'"),
        ("info.json", {"symmetries": [[1, 2]]}, "list of 4 x 4 matrices"),
        ("info.json", {"symmetries": [(2 * np.eye(4)).tolist()]}, "must be rigid transforms"),
    ],
)
def test_wrong_values_are_named_with_their_file(clip, file, changes, reason):
    edit(clip / file, **changes)
    with pytest.raises(InputError, match=reason) as caught:
        read_truth(clip)
    assert str(clip / file) in str(caught.value)


@pytest.mark.parametrize("file", ["camera.json", "init.json", "info.json"])
@pytest.mark.parametrize(
    ("text", "reason"), [("{", "cannot be read as JSON"), ("[1]", "is not a JSON object")]
)
def test_broken_documents_are_named(clip, file, text, reason):
    (clip / file).write_text(text)
    with pytest.raises(InputError, match=reason) as caught:
        read_truth(clip)
    assert str(clip / file) in str(caught.value)
